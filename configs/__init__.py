"""Configuration files in YAML: a folder for each group of choices."""
