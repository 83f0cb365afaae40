"""Models of other papers, to compare with. The core does not import them."""
