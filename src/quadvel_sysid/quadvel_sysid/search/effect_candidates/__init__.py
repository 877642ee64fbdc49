"""What the identification knows of each effect of the registry, module by module as there."""
