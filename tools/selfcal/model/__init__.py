"""The model file: laws, tables, regressors, forms."""
