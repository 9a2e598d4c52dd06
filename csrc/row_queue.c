/* A queue of rows from the engine's thread to a client, and of calls that wake the client.
 *
 * The thread never waits for a client: rows collect in a bounded number of chunks. The thread holds the
 * lock while it adds one exchange's rows, a client while it removes a chunk. */
#include "internal.h"

#include <stdlib.h>
#include <string.h>

enum { MOST_SPARE = 64, WORDS = MD_MOST_NUMBERS / 64 };

struct md_row_queue {
    pthread_mutex_t mutex; /* guards all fields below */
    pthread_cond_t is_called;
    size_t chunk_rows, most_chunks;
    struct md_columns **chunks; /* a ring buffer */
    size_t first, count;        /* index of the oldest chunk with rows; number of chunks with rows */
    struct md_columns *spare[MOST_SPARE]; /* empty chunks that clients gave back */
    size_t spares;
    size_t holders;             /* the client, chunks that it holds, and ports that report to the queue */
    uint64_t dropped;
    uint64_t called[WORDS];     /* one bit for each port number that was called */
    uint32_t calls;             /* number of bits that are set in `called` */
};

#if defined __APPLE__ || defined _WIN32 /* their condition variables do not support CLOCK_MONOTONIC */
#define RELATIVE_TIMES 1
#else
#define RELATIVE_TIMES 0
#endif

/* Initialise a condition variable with timeouts by CLOCK_MONOTONIC. */
static void init_condition(pthread_cond_t *condition)
{
#if RELATIVE_TIMES
    pthread_cond_init(condition, NULL);
#else
    pthread_condattr_t monotonic;
    pthread_condattr_init(&monotonic);
    pthread_condattr_setclock(&monotonic, CLOCK_MONOTONIC);
    pthread_cond_init(condition, &monotonic);
    pthread_condattr_destroy(&monotonic);
#endif
}

static int wait_until(pthread_cond_t *condition, pthread_mutex_t *mutex, int64_t until_ns)
{
#if RELATIVE_TIMES
    int64_t left = later(until_ns - md_now_ns(), 0);
    struct timespec span = timespec_of(left);
    return pthread_cond_timedwait_relative_np(condition, mutex, &span);
#else
    struct timespec until = timespec_of(until_ns);
    return pthread_cond_timedwait(condition, mutex, &until);
#endif
}

struct md_row_queue *md_row_queue_new(size_t chunk_rows, size_t most_chunks)
{
    struct md_row_queue *queue = calloc(1, sizeof *queue);
    struct md_columns **chunks = calloc(most_chunks, sizeof *chunks);
    if (!queue || !chunks) {
        free(queue);
        free(chunks);
        return NULL;
    }
    queue->chunks = chunks;
    queue->chunk_rows = chunk_rows;
    queue->most_chunks = most_chunks;
    queue->holders = 1;
    md_mutex_init(&queue->mutex);
    init_condition(&queue->is_called);
    return queue;
}

static void destroy(struct md_row_queue *queue)
{
    for (size_t i = 0; i < queue->count; i++)
        md_columns_free(queue->chunks[(queue->first + i) % queue->most_chunks]);
    while (queue->spares)
        md_columns_free(queue->spare[--queue->spares]);
    pthread_cond_destroy(&queue->is_called);
    pthread_mutex_destroy(&queue->mutex);
    free(queue->chunks);
    free(queue);
}

void md_row_queue_hold(struct md_row_queue *queue)
{
    pthread_mutex_lock(&queue->mutex);
    queue->holders++;
    pthread_mutex_unlock(&queue->mutex);
}

void md_row_queue_release(struct md_row_queue *queue)
{
    pthread_mutex_lock(&queue->mutex);
    int is_last = --queue->holders == 0;
    pthread_mutex_unlock(&queue->mutex);
    if (is_last)
        destroy(queue);
}

/* ---- rows ---- */

static struct md_columns *newest(struct md_row_queue *queue)
{
    return queue->count ? queue->chunks[(queue->first + queue->count - 1) % queue->most_chunks] : NULL;
}

/* Return an empty chunk: a spare or new one, or else the newest chunk, whose rows are dropped. */
static struct md_columns *begin_chunk(struct md_row_queue *queue)
{
    struct md_columns *chunk = NULL;
    if (queue->count < queue->most_chunks)
        chunk = queue->spares ? queue->spare[--queue->spares] : md_columns_new(queue->chunk_rows);
    if (chunk) {
        queue->chunks[(queue->first + queue->count++) % queue->most_chunks] = chunk;
    } else if ((chunk = newest(queue)) != NULL) {
        queue->dropped += chunk->rows;
        chunk->rows = 0;
    }
    return chunk;
}

/* Prefetch the memory of the next exchange's rows, because unlocking waits until all rows are written. */
static void look_ahead(const struct md_columns *chunk, size_t count)
{
    enum { CACHE_LINE = 64, NUMBERS = CACHE_LINE / sizeof(int64_t) };
    size_t first = chunk->rows + count, end = first + count;
    if (end > chunk->room)
        return;
    for (size_t row = first; row < end; row += NUMBERS) {
        __builtin_prefetch(chunk->time + row, 1);
        __builtin_prefetch(chunk->sent + row, 1);
        __builtin_prefetch(chunk->uncertainty + row, 1);
        __builtin_prefetch(chunk->value + row, 1);
    }
    __builtin_prefetch(chunk->drive + first, 1);
    __builtin_prefetch(chunk->reg + first, 1);
    __builtin_prefetch(chunk->status + first, 1);
}

void md_row_queue_add(struct md_row_queue *queue, const struct md_block *block,
                      const struct md_completion *completion)
{
    if (!block || block->count == 0)
        return;
    int64_t ahead_ns = completion->utc_ahead_ns ? completion->utc_ahead_ns : md_utc_minus_monotonic_ns();
    pthread_mutex_lock(&queue->mutex);
    struct md_columns *chunk = newest(queue);
    if (!chunk || !md_columns_add(chunk, block, completion, ahead_ns)) {
        chunk = begin_chunk(queue);
        if (!chunk || !md_columns_add(chunk, block, completion, ahead_ns))
            queue->dropped += (uint64_t)block->count;
    }
    if (chunk)
        look_ahead(chunk, (size_t)block->count);
    pthread_mutex_unlock(&queue->mutex);
}

void md_row_queue_miss(struct md_row_queue *queue, const struct md_block *block, int status, int64_t due_ns)
{
    md_row_queue_add(queue, block, &(struct md_completion){.result = -status, .begun_ns = due_ns});
}

struct md_columns *md_row_queue_take(struct md_row_queue *queue)
{
    struct md_columns *chunk = NULL;
    pthread_mutex_lock(&queue->mutex);
    if (queue->count) {
        chunk = queue->chunks[queue->first];
        queue->first = (queue->first + 1) % queue->most_chunks;
        queue->count--;
        queue->holders++;
    }
    pthread_mutex_unlock(&queue->mutex);
    return chunk;
}

void md_row_queue_give_back(struct md_row_queue *queue, struct md_columns *columns)
{
    columns->rows = 0;
    pthread_mutex_lock(&queue->mutex);
    int is_kept = queue->spares < MOST_SPARE;
    if (is_kept)
        queue->spare[queue->spares++] = columns;
    pthread_mutex_unlock(&queue->mutex);
    if (!is_kept)
        md_columns_free(columns);
    md_row_queue_release(queue);
}

size_t md_row_queue_chunks(struct md_row_queue *queue)
{
    pthread_mutex_lock(&queue->mutex);
    size_t count = queue->count;
    pthread_mutex_unlock(&queue->mutex);
    return count;
}

uint64_t md_row_queue_dropped(struct md_row_queue *queue)
{
    pthread_mutex_lock(&queue->mutex);
    uint64_t dropped = queue->dropped;
    pthread_mutex_unlock(&queue->mutex);
    return dropped;
}

/* ---- calls ---- */

void md_row_queue_call(struct md_row_queue *queue, uint32_t number)
{
    pthread_mutex_lock(&queue->mutex);
    uint64_t *word = &queue->called[number / 64], bit = UINT64_C(1) << number % 64;
    queue->calls += !(*word & bit);
    *word |= bit;
    pthread_cond_signal(&queue->is_called);
    pthread_mutex_unlock(&queue->mutex);
}

static int take_calls(struct md_row_queue *queue, uint32_t *numbers, int room)
{
    int n = 0;
    for (uint32_t word = 0; queue->calls && n < room; word++)
        for (; queue->called[word] && n < room; queue->calls--) {
            numbers[n++] = 64 * word + (uint32_t)__builtin_ctzll(queue->called[word]);
            queue->called[word] &= queue->called[word] - 1;
        }
    return n;
}

int md_row_queue_await(struct md_row_queue *queue, int64_t timeout_ns, uint32_t *numbers, int room)
{
    int64_t until_ns = md_now_ns() + timeout_ns;
    pthread_mutex_lock(&queue->mutex);
    while (!queue->calls && timeout_ns > 0 && wait_until(&queue->is_called, &queue->mutex, until_ns) == 0)
        ;
    int n = take_calls(queue, numbers, room);
    pthread_mutex_unlock(&queue->mutex);
    return n;
}
