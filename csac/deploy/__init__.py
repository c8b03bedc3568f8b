"""What leaves: a trained policy as an artefact that runs without JAX."""
