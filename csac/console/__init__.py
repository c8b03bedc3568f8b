"""Terminal output: the live display, tables and text. Nothing here imports JAX."""
