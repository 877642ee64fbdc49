"""Launch files, parameters, and the command line `quadvel`."""
