"""Identification of a device's own mechanics: signs of encoder and motor, friction, damping, and tests of a material.

Imports no JAX.
"""
