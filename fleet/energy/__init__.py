"""What the packs of a fleet still give: the cell's chemistry and the battery's books."""
