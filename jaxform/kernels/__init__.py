"""All that is there because of XLA: loops over blocks, sealed operations, derivatives by hand, bucket sizes.

docs/explanation/kernels.md says what each is for.
"""
