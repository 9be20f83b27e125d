"""Recovery of a data folder: damaged items, and leftovers of killed processes."""
