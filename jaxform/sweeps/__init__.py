"""Many designs on many processes or machines: tables of designs, their evaluation, records and pictures."""
