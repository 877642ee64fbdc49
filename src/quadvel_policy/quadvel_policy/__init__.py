"""The controller: observation and action, policy file, modes and their safety, command mux, and the nodes."""
