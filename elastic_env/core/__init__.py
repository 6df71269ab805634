"""Shared basics: errors, validated models, text formats, tables of signals, compilation."""
