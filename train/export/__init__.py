"""Compensators and residuals for programs without Python: C99 and ONNX."""
