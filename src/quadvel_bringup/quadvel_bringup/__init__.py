"""Start the nodes together: launch files, parameters and the `quadvel` command line."""
