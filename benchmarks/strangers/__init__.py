"""Molds as strangers bring them: flanges in the sheet's plane, parts from a CAD kernel."""
