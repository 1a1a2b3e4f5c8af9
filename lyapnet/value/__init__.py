"""V(t, x), its derivatives and expansions, and the control laws that it defines."""
