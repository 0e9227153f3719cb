"""Whether and how fast the fixed-point iteration converges, from the plant's symbols or from a run.

The plant realises the request r as f(r): its response (exact parameters) to the command that the model (approximate
parameters) computes for r. With J = df/dr and the effective gain a of a deformation, an error of the request is
multiplied by I - a J in every cycle, so the iteration converges when |1 - a lambda| < 1 for every eigenvalue lambda of J.
"""
