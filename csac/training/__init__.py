"""How it is learnt: the only room that steps environments and that batches over seeds."""
