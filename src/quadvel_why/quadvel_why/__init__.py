"""Diagnosis of recordings: from a run that failed to the first link of the chain that breaks (`quadvel why`)."""
