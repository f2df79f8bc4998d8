"""The joint adjustment of everything that was seen of a cell."""
