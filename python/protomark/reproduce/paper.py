"""What the paper reports, to stand beside our figures.

Komorowski and Trzcinski, "Aggregation of binary feature descriptors for compact scene model
representation in large scale structure-from-motion applications". One training, one validation and
one test sequence of a Google Tango tablet, FREAK with 512 bits.
"""

from __future__ import annotations

SOURCE = (
    "Komorowski and Trzciński, *Aggregation of binary feature descriptors for compact scene model "
    "representation in large scale structure-from-motion applications*"
)
TRAINING_DESCRIPTORS = "over 4 million"

# Section "Network architectures evaluation", on the test sequence.
PRECISION_BY_DIM = {8: 0.40, 16: 0.65, 32: 0.75, 64: 0.79}

# The table of section "Final evaluation", by the names that our rows have.
TABLE = {
    "unaggregated": 0.796,
    "prototypes-32": 0.750,
    "prototypes-16": 0.676,
    "majority": 0.671,
    "pca-16-float": 0.581,
    "random": 0.526,
}
