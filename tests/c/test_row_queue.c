/* A row has the time of its exchange even if the wall clock is changed in between. This test replaces the
 * clocks. */
#include "internal.h"

#include <assert.h>
#include <stddef.h>

static int64_t ahead_ns;

int64_t md_now_ns(void)
{
    return 0;
}

int64_t md_utc_minus_monotonic_ns(void)
{
    return ahead_ns;
}

int main(void)
{
    enum { ROWS = 100 };
    const int64_t every_ns = 10000000;
    struct md_field field = {.multiplier = 1, .divisor = 1};
    struct md_block block = {.fields = &field, .count = 1};
    struct md_row_queue *row_queue = md_row_queue_new(ROWS, 1);
    assert(row_queue);
    for (int64_t n = 0; n < ROWS; n++) {
        ahead_ns = n < ROWS / 2 ? 1000 : 7000; /* half-way, the clock is set, or the machine slept */
        struct md_completion completion = {.result = MD_NO_REPLY, .begun_ns = (n + 1) * every_ns};
        if (n == ROWS / 2) { /* this request was sent before the clock change, and timed out after it */
            completion.sent_ns = completion.begun_ns;
            completion.utc_ahead_ns = 1000;
        }
        md_row_queue_add(row_queue, &block, &completion);
    }
    struct md_columns *columns = md_row_queue_take(row_queue);
    assert(columns && columns->rows == ROWS);
    for (int n = 0; n < ROWS; n++)
        assert(columns->time[n] - columns->sent[n] == (n <= ROWS / 2 ? 1000 : 7000));
    md_row_queue_give_back(row_queue, columns);
    md_row_queue_release(row_queue);
    return 0;
}
