"""Lets the tests in folders below import the helpers here."""
