"""Learning from cycle to cycle: the law and its arithmetic, and what is kept of it between runs."""
