"""How it is learnt: the only room that knows about several seeds, processes and resuming."""
