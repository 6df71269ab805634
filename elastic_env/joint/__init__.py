"""The elastic joint: its formulas, its servo, and the transform of rigid hinges."""
