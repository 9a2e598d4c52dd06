"""The history of a plant: months of rows in a folder, which may be read while it is written.

| in the folder                             | contents                                                   |
|-------------------------------------------|------------------------------------------------------------|
| `rows.NUMBER.arrows`                      | a segment as it was recorded; the last one still grows     |
| `rows/NUMBER.BEGIN-END.parquet`           | the same rows, ordered by drive and time                   |
| `tens/FIRST-LAST.BEGIN-END.parquet`       | the same segments, with ten seconds of a register per row  |
| `damaged/rows.NUMBER.arrows`              | a damaged segment; `rows` has its readable part            |

Numbers grow, also across restarts. `tens` are summaries of ten seconds. Three rules make a reader use each
row exactly once:

1. Rows of a segment are read from `rows/` if they are there, else from `rows.NUMBER.arrows`. 2. Tens are read
from the file with the widest range of numbers; without such a file they are computed from the
   rows.
3. An incomplete file has a name that starts with a dot. It is renamed when it is complete and on the disk,
   `tens` before `rows`. Then the files that it replaces are removed. A reader lists the folder, then `rows/`,
   then `tens/`, so it finds the old or the new file. The rules above prevent that it uses both.

BEGIN and END are UTC, such as 20261122T213700Z, and enclose the times of all rows in the file.
"""

from multidrop.history.buckets import Buckets as Buckets
from multidrop.history.history import HistoryRows as HistoryRows
from multidrop.history.writer import HistoryState as HistoryState
from multidrop.history.writer import HistoryWriter as HistoryWriter
