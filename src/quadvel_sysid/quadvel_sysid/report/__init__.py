"""What an identification found, as a page for people and a file for programs."""
