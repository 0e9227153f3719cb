"""Learning the model: estimators of parameters and rules of adaptation."""
