"""How helpers of compiled functions are compiled."""

BORROWED = {"_nrt": False}
"""An option of numba for helpers that allocate nothing: they count no references to the arrays they are given. Counting took
longer than the work of small helpers. The compiler refuses it where something is allocated."""
