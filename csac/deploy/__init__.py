"""Load trained policies and export them as artefacts that run without JAX."""
