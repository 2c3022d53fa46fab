"""General utilities: errors, validation, random numbers, files, plugins and buffers."""
