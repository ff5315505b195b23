"""How helpers of compiled functions are compiled."""

BORROWED = {"_nrt": False}
"""An option of numba for helpers that allocate nothing: they count no references to the arrays they are given. Counting took
longer than the work of small helpers. The compiler refuses it where something is allocated."""
REORDERED = {"fastmath": {"reassoc", "contract", "arcp", "nsz"}, "forceinline": True}
"""What the compiler may do to sums, so that it can use vector instructions; NaN and infinity keep their meaning. Such helpers are
always part of their callers: else a process that compiles them calls another copy, with sums in another order, than one that
loads its callers from the cache."""
