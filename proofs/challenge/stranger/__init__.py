"""A second generator of concealed recordings, which shares nothing with the first but the seal.

Other state variables, another integrator, other forms and parameters of the effects, another
controller and the nuisances of real laboratories. Its equations come from the literature named in
:mod:`~proofs.challenge.stranger.effects`, not from :mod:`ventbench.physics`.
"""
