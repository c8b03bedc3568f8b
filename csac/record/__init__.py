"""Write and read run directories, compute statistics over seeds, draw plots. Nothing here imports JAX."""
