"""Wrap Gymnasium tasks as environments with flat arrays; perturb, vectorise and save them. No JAX."""
