"""The elastic joint: its formulas, its servo, and the transform that makes the hinges of a rigid
model elastic.
"""
