"""The parts of `report.html`: its template, style and scripts, and what Python puts into them."""
