"""Code that exists because of XLA: loops over blocks, opaque operations, derivative rules, bucket sizes.

docs/explanation/kernels.md says what each is for.
"""
