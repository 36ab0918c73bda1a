"""Many recordings at once: which files, what each shows, limits of a data sheet, the population of the units."""
