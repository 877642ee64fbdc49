"""Report of an identification: an HTML page for people, JSON and YAML files for programs."""
