"""Text for people: numbers with intervals, tables that fit, files to be written."""
