"""Driver of the real robot: packets of its board, UDP link, and the node `driver`."""
