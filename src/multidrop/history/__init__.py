"""The history of a plant: months of rows in a folder, which may be read while it is written.

| in the folder                             | contents                                                   |
|-------------------------------------------|------------------------------------------------------------|
| `rows.NUMBER.arrows`                      | a segment as it was recorded; the last one still grows     |
| `rows/NUMBER.BEGIN-END.parquet`           | the rows of a closed segment, ordered by drive and time    |
| `tens/FIRST-LAST.BEGIN-END.parquet`       | summaries of segments: ten seconds of a register per row   |
| `damaged/rows.NUMBER.arrows`              | a damaged segment; `rows/` has its readable part           |

NUMBER, FIRST and LAST are segment numbers, which only grow, also across restarts. BEGIN and END are UTC, such
as 20261122T213700Z, and enclose the times of all rows in the file. Three rules make a reader use each row
exactly once:

1. Rows of a segment are read from `rows/` if they are there, else from `rows.NUMBER.arrows`.
2. Summaries are read from the file in `tens/` with the widest range of segment numbers. Without such a file
   they are computed from the rows.
3. An incomplete file has a name that starts with a dot. A file gets its final name when it is complete and
   on the disk, in `tens/` before `rows/`. Then the files that it replaces are removed. A reader lists the
   folder, then `rows/`, then `tens/`, so it finds the replaced files or the new one. If it finds both, rules
   1 and 2 select one.
"""

from multidrop.history.buckets import Buckets as Buckets
from multidrop.history.history import HistoryRows as HistoryRows
from multidrop.history.writer import HistoryState as HistoryState
from multidrop.history.writer import HistoryWriter as HistoryWriter
