"""What recordings are asked for before a fit, and what there is to doubt about it afterwards."""
