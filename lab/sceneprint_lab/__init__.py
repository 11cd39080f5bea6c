"""What makes and judges models: synthetic scenes, training, evaluation."""
