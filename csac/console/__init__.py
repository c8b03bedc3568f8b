"""What is told: the live display, tables and text for people. Nothing here imports JAX."""
