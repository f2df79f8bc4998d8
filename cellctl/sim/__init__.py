"""The simulated cell: a world that is a process of its own, and the drivers that talk to it."""
