"""Runs that outgrow one machine: the same stages on Ray Data, results as Parquet data sets."""
