"""Pictures that a problem adds to those of every report: frozen values that draw runs."""
