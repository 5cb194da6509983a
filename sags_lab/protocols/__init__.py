"""`sags eval --protocol`: public data sets in their own layouts, by their own rules (docs/evaluation.md)."""
