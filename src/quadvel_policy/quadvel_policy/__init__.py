"""The controller: observation and action, the policy file, the modes and their safety, the command mux, and their nodes."""
