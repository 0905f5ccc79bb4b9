"""Episodes and recordings ↔ the file formats of other robot learning and viewing tools."""
