"""What an operator does to a data folder: check it, copy it, put it back, thin it out."""
