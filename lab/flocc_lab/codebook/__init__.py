"""How the codebook of the classical front end was learnt, from generated images."""
