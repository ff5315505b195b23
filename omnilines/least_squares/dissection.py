"""A graph cut into parts by few separating nodes (nested dissection, A. George 1973).

The nodes are brought into the order of Cuthill and McKee, in which neighbours are near each other, and halved. Of the edges
between the halves a least set of nodes that touches them all separates these: by Koenig's theorem it follows from a largest
matching. Each half without its separators is cut again until it is small.
"""

import numpy as np
import scipy.sparse
from jaxtyping import Bool, Int
from scipy.sparse.csgraph import maximum_bipartite_matching, reverse_cuthill_mckee


def dissected(
    row: Int[np.ndarray, " edges"], column: Int[np.ndarray, " edges"], nodes: int, most: int
) -> Int[np.ndarray, " nodes"]:
    """The part of every node, -1 for those that separate: no edge joins two parts, and no part has more than `most` nodes."""
    ones = np.ones(len(row), dtype=np.int8)
    graph = scipy.sparse.csr_array((ones, (row, column)), shape=(nodes, nodes))
    graph = scipy.sparse.csr_array(graph + graph.T)
    part, count, waiting = np.full(nodes, -1), 0, [np.arange(nodes)]
    while waiting:
        own = waiting.pop()
        if len(own) <= most:
            part[own] = count
            count += len(own) > 0
            continue
        within = graph[own][:, own]
        order = own[reverse_cuthill_mckee(scipy.sparse.csr_array(within), symmetric_mode=True)]
        pieces = -(-len(own) // most)
        # In proportion to the pieces of either side, so that these come out alike.
        low, high = np.split(order, [len(own) * (pieces // 2) // pieces])
        of_low, of_high = covering(scipy.sparse.csr_array(graph[low][:, high]))
        waiting += [high[~of_high], low[~of_low]]
    return part


def covering(between: scipy.sparse.csr_array) -> tuple[Bool[np.ndarray, " rows"], Bool[np.ndarray, " columns"]]:
    """The fewest rows and columns that hold every entry of a matrix (D. Koenig 1931)."""
    partner = np.asarray(maximum_bipartite_matching(between, perm_type="column"))
    rows, columns = partner < 0, np.zeros(between.shape[1], dtype=bool)
    matched = np.flatnonzero(partner >= 0)
    # Rows without a partner, and all that is reached from them by edges to a column and by partners back.
    while True:
        reached = between.T.astype(np.int64) @ rows > 0
        again = rows.copy()
        again[matched] = reached[partner[matched]]
        if (again == rows).all() and (reached == columns).all():
            return ~rows, columns
        rows, columns = again | rows, reached
