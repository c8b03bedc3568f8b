"""Where it is learnt: Gymnasium tasks in, flat arrays out, and their changes. Nothing here imports JAX."""
