"""The HTML report, figures for papers, videos and the live view."""
