"""The parts of `report.html`: its template, style and scripts, and the data blocks made in Python."""
