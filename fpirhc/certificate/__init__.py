"""Hard limits of every plant of a box of parameters; `fp.certify_limits` asks for them. Theory: docs/certificate.md."""
