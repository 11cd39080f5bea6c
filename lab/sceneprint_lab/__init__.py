"""Training and evaluation of models: synthetic scenes, training, evaluation."""
