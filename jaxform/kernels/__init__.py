"""All that is there because of XLA: loops over blocks, sealed operations, derivatives by hand, the ladder of sizes.

docs/explanation/kernels.md says what each is for.
"""
