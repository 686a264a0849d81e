"""Filters of other libraries behind the estimators' protocol; each library is imported on use."""
