"""Pictures that a problem wants in its report, beyond those of every report: frozen values that draw runs."""
