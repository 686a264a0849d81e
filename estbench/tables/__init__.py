"""Numbers with intervals as text, tables, and the paths of files that are written."""
