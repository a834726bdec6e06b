"""The field-latent VAE: the paper's, and ours."""
