"""The controller: observation and action, policy file, modes and safety, command mux, and the nodes."""
