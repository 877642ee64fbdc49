"""What every node stands on: messages to records and back, parameters, diagnostics and the choice of ticks."""
