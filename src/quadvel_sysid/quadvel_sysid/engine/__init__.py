"""From logs to the corrected model: delays and gains, effects by name, terms for what no law explains."""
