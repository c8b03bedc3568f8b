"""What is written: run directories, statistics over seeds, pictures. Nothing here imports JAX."""
