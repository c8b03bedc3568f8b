"""How good it is: policies on episodes of their own, in this process or several, and for the eye. No JAX."""
