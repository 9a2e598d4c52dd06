/* Answers that come after their time-out: what line.c asks of late.c. */
#ifndef MULTIDROP_LATE_H
#define MULTIDROP_LATE_H

#include "multidrop.h"

/* A late answer could be taken for its reply, and it may not be sent now. */
int md_late_bars(const struct md_exchange *exchange, int64_t now_ns);
/* An answer to the same question is outstanding: then a second copy of it is no adapter's echo. */
int md_late_is_repeated(const struct md_exchange *exchange);
/* The exchange under way is over, and its answer may still come: for so long in any order. */
void md_late_expect(struct md_line *line, int64_t window_ns);
/* Answers of this drive may still come that were asked for on another line, or before the port was lost. */
void md_late_resume(struct md_line *line, struct md_drive *drive);
/* Account for the late answer that begins there: its length, MD_INCOMPLETE, or MD_NO_START. Where it may answer
 * the exchange under way instead, `since_ns` is to have the time at which that was asked first, 0 if it never
 * was; else NULL. */
int md_late_take(struct md_line *line, size_t at, int64_t now_ns, int64_t *since_ns);
/* The reply is an exception, or its one register lies between these; `most` 0: it may hold anything. */
int md_is_in_range(const struct md_message *reply, uint16_t least, uint16_t most);
int md_is_read(int framing, uint8_t function);

/* Others look at it meanwhile. */
static inline void md_count_failures(struct md_drive *drive, uint32_t failures)
{
    __atomic_store_n(&drive->failures, failures, __ATOMIC_RELAXED);
}

#endif
