"""Training and evaluation of models, with synthetic scenes."""
