"""The real robot: the packets of its board, the link to it, and the node that puts topics around both."""
