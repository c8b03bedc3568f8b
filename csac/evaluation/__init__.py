"""Evaluate policies in separate environments, in one or several processes; play, film and export them. No JAX."""
