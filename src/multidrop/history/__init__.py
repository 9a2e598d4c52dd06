"""The history of a plant: months of rows in a folder, written while they are read.

| in the folder                             | what it holds                                              |
|-------------------------------------------|------------------------------------------------------------|
| `rows.NUMBER.arrows`                      | a segment as it was recorded; the last one still grows     |
| `rows/NUMBER.BEGIN-END.parquet`           | the same rows, ordered by drive and time                   |
| `tens/FIRST-LAST.BEGIN-END.parquet`       | of these segments, ten seconds of a register in each row   |
| `damaged/rows.NUMBER.arrows`              | a segment of which `rows` has only what could be read      |

Numbers grow, also over restarts. Three rules say where a row is read, so that it is read exactly once:

1. Rows of a segment are read from `rows/` if they are there, else from `rows.NUMBER.arrows`.
2. Tens are read from the file with the widest range of numbers, else they are reckoned from the rows.
3. A file in the making has a name that starts with a point. It is renamed when it is complete and on the
   disk, `tens` before `rows`; only then is what it replaces removed. A reader lists the folder, then `rows/`,
   then `tens/`, so it meets the old or the new, and by the rules above never both.

BEGIN and END are UTC, such as 20261122T213700Z, and enclose the times of all rows in the file.
"""

from multidrop.history.buckets import Buckets as Buckets
from multidrop.history.history import HistoryRows as HistoryRows
from multidrop.history.writer import HistoryState as HistoryState
from multidrop.history.writer import HistoryWriter as HistoryWriter
