"""The membrane element, its forces and their derivatives, and the nodal fields they act on."""
