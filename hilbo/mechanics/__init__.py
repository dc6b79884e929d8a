"""Fractional-order standard linear solid (FO-SLS): memory, recursion, responses, special cases, switching, passivity.

Imports `numerics`; `hilbo.viscoelastic` and `hilbo.passivity` are its public interface.
"""
