"""Look rather than read: the HTML report, paper figures, ghost videos and the live view."""
