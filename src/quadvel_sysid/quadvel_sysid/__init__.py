"""What measured logs say about the joints: residual, diagnosis, correction, before and after."""
