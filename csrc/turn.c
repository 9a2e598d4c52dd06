/* The order of exchanges on a line: first urgent ones, then queued ones that are due, then repeated ones.
 * Even if urgent exchanges never pause, queued and repeated ones get a share of the line, except while a stop
 * waits.
 *
 * The caller passes the time, moves the bytes, and holds the engine's lock; only md_turn_submit() needs no
 * lock. */
#include "line.h"

/* ---- requests before an exchange ---- */

enum { MOST_PROOFS_SENT = 12 }; /* limit of the proofs sent before one exchange */

/* Return the request to send before the exchange: an echo probe, or a proof, so that no late reply is
 * mistaken for the exchange's reply. NULL: send the exchange itself. */
static const struct md_exchange *find_before(struct md_before *before, const struct md_exchange *exchange,
                                             int is_echo_in_doubt, int64_t now_ns)
{
    const struct md_drive *drive = exchange->drive;
    if (before->then != exchange)
        *before = (struct md_before){.then = exchange, .failures = drive->failures};
    const struct md_exchange *proof = md_late_proof(exchange, now_ns);
    int has_helped = before->proofs == 0 || md_replies(drive) != before->replies;
    if (proof && has_helped && before->proofs < MOST_PROOFS_SENT) {
        before->proofs++;
        before->replies = md_replies(drive);
        return proof;
    }
    if (!exchange->echo_probe || !is_echo_in_doubt || before->is_probed)
        return NULL;
    before->is_probed = 1;
    return exchange->echo_probe;
}

/* Return 1 if the exchange must be sent again, because its reply may belong to an earlier request. Never
 * repeat a write: it may have started a motor. */
static int is_again(struct md_before *before, const struct md_exchange *exchange,
                    const struct md_completion *completion)
{
    int is_in_doubt = completion->result == MD_LATE_ANSWER_DUE && completion->sent_ns;
    if (is_in_doubt && md_is_read(exchange->framing, exchange->request.function) &&
        before->proofs < MOST_PROOFS_SENT)
        return 1;
    before->then = NULL;
    return 0;
}

/* ---- the queue ---- */

void md_turn_init(struct md_turn *turn, struct md_slot *slots, uint32_t room, int64_t now_ns)
{
    *turn = (struct md_turn){.slots = slots, .room = room, .is_idle = 1};
    md_line_init(&turn->line, now_ns);
}

int md_turn_submit(struct md_turn *turn, const struct md_exchange *const *exchanges,
                   const int64_t *not_before_ns, int n)
{
    uint32_t submitted = turn->progress.submitted;
    uint32_t free_slots = turn->room - (submitted - md_load(&turn->progress.done));
    int taken = 0;
    for (; taken < n && (uint32_t)taken < free_slots; taken++)
        turn->slots[(submitted + (uint32_t)taken) & (turn->room - 1)] =
            (struct md_slot){.exchange = exchanges[taken], .not_before_ns = not_before_ns[taken]};
    md_store(&turn->progress.submitted, submitted + (uint32_t)taken);
    return taken;
}

uint32_t md_turn_repeat(struct md_turn *turn, const struct md_exchange *const *exchanges, uint32_t n)
{
    uint32_t next = turn->round_at;
    turn->round = exchanges;
    turn->round_len = turn->progress.lost ? 0 : n;
    turn->round_at = 0;
    md_store(&turn->progress.repeating, turn->round_len > 0);
    return next;
}

void md_turn_add_urgent(struct md_turn *turn, struct md_urgent *urgent)
{
    struct md_urgent **at = &turn->urgent;
    if (*at && turn->source == MD_URGENT) /* the first request is in flight: stay behind it */
        at = &(*at)->next;
    for (struct md_urgent **waiting = at; *waiting; waiting = &(*waiting)->next)
        if (!urgent->exchange->insists || (*waiting)->exchange->insists) /* stops precede other requests */
            at = &(*waiting)->next;
    urgent->next = *at;
    *at = urgent;
}

void md_turn_set_echo(struct md_turn *turn, int echo)
{
    turn->line.echo = (uint8_t)echo;
    turn->line.echo_is_configured = echo == MD_ECHO; /* MD_NO_ECHO is not final: an echo may still come */
    md_store(&turn->progress.echo, (uint32_t)echo);
}

int md_turn_end(struct md_turn *turn)
{
    turn->is_ending = 1;
    int is_waiting = turn->source == MD_NO_SOURCE || md_line_is_postponed(&turn->line);
    return !is_waiting && turn->source != MD_URGENT;
}

/* The line time of an exchange starts with the silence before it, never before the line's last activity (see
 * measure() in reply.c). */
int64_t md_turn_counted_ns(const struct md_turn *turn, int64_t now_ns)
{
    const struct md_line *line = &turn->line;
    if (md_line_is_under_way(line))
        return line->completion->sent_ns - line->silence_ns;
    return sooner(now_ns, later(line->quiet_ns, now_ns - line->silence_ns));
}

int md_turn_is_asking(const struct md_turn *turn, const struct md_drive *drive)
{
    if (turn->source != MD_NO_SOURCE && turn->line.exchange->drive == drive)
        return 1;
    uint32_t submitted = md_load(&turn->progress.submitted);
    for (uint32_t at = turn->progress.done; at != submitted; at++)
        if (turn->slots[at & (turn->room - 1)].exchange->drive == drive)
            return 1;
    for (uint32_t at = 0; at < turn->round_len; at++)
        if (turn->round[at]->drive == drive)
            return 1;
    for (const struct md_urgent *urgent = turn->urgent; urgent; urgent = urgent->next)
        if (urgent->exchange->drive == drive)
            return 1;
    return 0;
}

void md_count_stop(uint32_t *stops)
{
    __atomic_fetch_add(stops, 1, __ATOMIC_SEQ_CST);
}

enum {
    FIRST_PART = 4,         /* first stops of silent drives wait for reads during 1/4 of a timeout */
    POLLED = 20,            /* polling gets 1/20 of a line that urgent requests keep busy */
    MOST_OWED_NS = 50000000 /* limit of owed_ns, the line time that polling may catch up on */
};

static uint32_t pending(const struct md_turn *turn)
{
    return md_load(&turn->progress.submitted) - turn->progress.done;
}

static void call(struct md_turn *turn)
{
    if (turn->row_queue)
        md_row_queue_call(turn->row_queue, turn->number);
}

/* Return 1 if the time `from_ns` has come; otherwise lower wake_ns to `from_ns`. */
static int is_time(int64_t from_ns, int64_t *wake_ns, int64_t now_ns)
{
    if (now_ns >= from_ns)
        return 1;
    *wake_ns = sooner(*wake_ns, from_ns);
    return 0;
}

/* ---- the start of an exchange ---- */

/* Return the earliest time for a request to the exchange's drive. A broadcast waits for no drive. */
static int64_t ready_ns(const struct md_exchange *exchange)
{
    return exchange->request.address ? exchange->drive->ready_ns : 0;
}

/* Start the exchange and return 1; or, if another request must precede it, start that one and return 0. */
static int begin(struct md_turn *turn, int source, const struct md_exchange *exchange,
                 struct md_completion *completion, int64_t now_ns)
{
    const struct md_exchange *first =
        find_before(&turn->before, exchange, md_echo_is_in_doubt(&turn->line), now_ns);
    turn->source = first ? MD_AHEAD : source;
    md_line_begin(&turn->line, first ? first : exchange, first ? &turn->completion : completion, now_ns);
    if (turn->progress.lost)
        md_line_abandon(&turn->line, MD_LINE_LOST, turn->progress.lost_error);
    return !first;
}

/* ---- urgent requests ---- */

/* Return 1 if a stop came after the urgent request in flight and no byte of the request has left. */
static int is_overtaken(const struct md_turn *turn)
{
    if (turn->source != MD_URGENT || turn->line.tx_at > 0)
        return 0;
    const struct md_exchange *exchange = turn->urgent->exchange;
    return exchange->stops && md_load(exchange->stops) != exchange->stops_seen;
}

static int is_silent(const struct md_exchange *exchange)
{
    return exchange->drive->failures > 0;
}

/* Return 1 if stops of drives that answer, and their reads, precede this request: after an exchange with a
 * silent drive, for as long as that exchange took. They would otherwise wait for the timeouts of all silent
 * drives that are being stopped. */
static int gives_way(const struct md_turn *turn, const struct md_exchange *exchange, int64_t now_ns)
{
    if (exchange->is_stop_read || (exchange->insists && !is_silent(exchange)))
        return 0;
    return now_ns < turn->missed_ns + turn->miss_ns;
}

/* Return 1 if reads must not precede this stop: the first stop of a silent drive waits for reads during
 * 1/FIRST_PART of the latest timeout only, because the drive may be back, with a running motor. */
static int precedes_reads(const struct md_turn *turn, const struct md_exchange *exchange, int64_t now_ns)
{
    int is_first = exchange->insists && !exchange->timeout_ns; /* repeated stops have a least timeout */
    return is_first && now_ns >= turn->missed_ns + turn->miss_ns / FIRST_PART;
}

/* Move the first request that may be sent now to the front and return it; otherwise set wake_ns. While a stop
 * waits for its drive, send only other stops: the stop must not wait for further exchanges. */
static struct md_urgent *find_urgent(struct md_turn *turn, int *is_held, int64_t *wake_ns, int64_t now_ns)
{
    struct md_urgent **found = NULL;
    int are_reads_held = 0;
    for (struct md_urgent **at = &turn->urgent; *at; at = &(*at)->next) {
        const struct md_exchange *exchange = (*at)->exchange;
        int is_preferred = !gives_way(turn, exchange, now_ns);
        if (!exchange->insists && (*is_held || are_reads_held))
            break;
        are_reads_held |= precedes_reads(turn, exchange, now_ns);
        if (found && !is_preferred)
            continue;
        if (!is_time(later((*at)->not_before_ns, ready_ns(exchange)), wake_ns, now_ns)) {
            *is_held |= exchange->insists;
            continue;
        }
        found = at;
        if (is_preferred)
            break;
    }
    struct md_urgent *urgent = found ? *found : NULL;
    if (urgent) {
        *found = urgent->next;
        urgent->next = turn->urgent;
        turn->urgent = urgent;
    }
    return urgent;
}

/* ---- polling ---- */

/* Return 1 if the slot must be skipped, because the same exchange's next slot is already due. */
static int is_over(const struct md_turn *turn, const struct md_slot *slot, int64_t now_ns)
{
    int64_t period_ns = slot->exchange->period_ns;
    if (!period_ns || now_ns < slot->not_before_ns + period_ns)
        return 0;
    uint32_t submitted = md_load(&turn->progress.submitted);
    for (uint32_t at = turn->progress.done + 1; at != submitted; at++) {
        const struct md_slot *next = &turn->slots[at & (turn->room - 1)];
        if (next->exchange == slot->exchange)
            return now_ns >= next->not_before_ns;
    }
    return 0;
}

/* Start the next queued exchange and return 1; if it is not due yet, set wake_ns and return 0. */
static int take_queued(struct md_turn *turn, int64_t *wake_ns, int64_t now_ns)
{
    const struct md_slot *slot = &turn->slots[turn->progress.done & (turn->room - 1)];
    if (!is_time(later(slot->not_before_ns, ready_ns(slot->exchange)), wake_ns, now_ns))
        return 0;
    if (begin(turn, MD_QUEUED, slot->exchange, &turn->completion, now_ns) && is_over(turn, slot, now_ns))
        md_line_abandon(&turn->line, MD_EXPIRED, 0);
    return 1;
}

static int take_polled(struct md_turn *turn, int64_t *wake_ns, int64_t now_ns)
{
    if (turn->is_ending || turn->progress.lost) /* the client takes the queued exchanges back */
        return 0;
    if (pending(turn) && take_queued(turn, wake_ns, now_ns))
        return 1;
    if (!turn->round_len || !is_time(ready_ns(turn->round[turn->round_at]), wake_ns, now_ns))
        return 0;
    if (begin(turn, MD_REPEATED, turn->round[turn->round_at], &turn->completion, now_ns))
        turn->round_at = turn->round_at + 1 < turn->round_len ? turn->round_at + 1 : 0;
    return 1;
}

static void stop_repeating(struct md_turn *turn)
{
    turn->round_len = 0;
    md_store(&turn->progress.repeating, 0);
    call(turn);
}

/* ---- turns ---- */

static void settle(struct md_turn *turn, int64_t took_ns, int64_t now_ns)
{
    const struct md_exchange *exchange = turn->line.exchange;
    if (is_silent(exchange) && turn->source != MD_AHEAD) {
        turn->missed_ns = now_ns;
        turn->miss_ns = exchange->is_stop_read ? 0 : took_ns;
    }
    if (turn->source == MD_URGENT)
        turn->owed_ns += took_ns / (POLLED - 1);
    else if (turn->source != MD_AHEAD && turn->owed_ns > 0)
        turn->owed_ns -= took_ns;
    turn->owed_ns = sooner(turn->owed_ns, MOST_OWED_NS);
}

/* Start the drive's interval after an exchange that was sent. */
static void rest(const struct md_exchange *exchange, const struct md_completion *completion, int64_t now_ns)
{
    if (exchange->drive->interval_ns && completion->sent_ns)
        exchange->drive->ready_ns = now_ns + exchange->drive->interval_ns;
}

static int is_stop_waiting(const struct md_turn *turn)
{
    for (const struct md_urgent *urgent = turn->urgent; urgent; urgent = urgent->next)
        if (urgent->exchange->insists)
            return 1;
    return 0;
}

/* Return 1 if a polled exchange may precede the urgent requests: never twice in a row, and never before a
 * stop. */
static int is_polling_due(const struct md_turn *turn)
{
    return !is_stop_waiting(turn) && turn->owed_ns > 0 && turn->last == MD_URGENT;
}

/* Start the next exchange and return 1; if no exchange is due yet, set wake_ns and return 0. */
static int take(struct md_turn *turn, int64_t *wake_ns, int64_t now_ns)
{
    int is_held = 0;
    *wake_ns = MD_NEVER;
    struct md_urgent *urgent = find_urgent(turn, &is_held, wake_ns, now_ns);
    if (!is_held && (!urgent || is_polling_due(turn)) && take_polled(turn, wake_ns, now_ns))
        return 1;
    if (urgent) {
        if (begin(turn, MD_URGENT, urgent->exchange, urgent->completion, now_ns) && is_overtaken(turn))
            md_line_abandon(&turn->line, MD_EXPIRED, 0);
        return 1;
    }
    if (!turn->is_ending && !pending(turn)) {
        md_store(&turn->is_idle, 1);
        if (pending(turn)) /* exchanges were queued since the check above */
            *wake_ns = now_ns;
    }
    return 0;
}

/* Add the rows of a polled exchange, and call the client if the port needs attention. */
static void report(struct md_turn *turn)
{
    const struct md_exchange *exchange = turn->line.exchange;
    const struct md_completion *completion = &turn->completion;
    if (turn->row_queue)
        md_row_queue_add(turn->row_queue, exchange->block, completion);
    int is_refusal = completion->result > 0 && completion->reply.exception;
    if (is_refusal || exchange->drive->failures != turn->before.failures)
        call(turn);
}

/* Make the last repeated exchange the next one again. */
static void step_back(struct md_turn *turn)
{
    if (turn->round_len)
        turn->round_at = (turn->round_at ? turn->round_at : turn->round_len) - 1;
}

/* Put the latest exchange back into its queue: an urgent one behind the stops that came since. */
static void put_back(struct md_turn *turn, int source)
{
    if (source == MD_URGENT) {
        struct md_urgent *urgent = turn->urgent;
        turn->urgent = urgent->next;
        md_turn_add_urgent(turn, urgent);
    } else if (source == MD_REPEATED) {
        step_back(turn);
    }
}

static void finish(struct md_turn *turn)
{
    int source = turn->source;
    turn->last = source;
    turn->source = MD_NO_SOURCE;
    if (turn->progress.echo != (uint32_t)turn->line.echo)
        md_store(&turn->progress.echo, (uint32_t)turn->line.echo);
    if (turn->progress.foreign != turn->line.foreign)
        md_store(&turn->progress.foreign, turn->line.foreign);
    if (turn->progress.stalled && turn->line.completion->result > 0)
        md_store(&turn->progress.stalled, 0);
    if (source == MD_AHEAD)
        return;
    int goes_on = !turn->progress.lost && (source == MD_URGENT || !turn->is_ending);
    if (is_again(&turn->before, turn->line.exchange, turn->line.completion) && goes_on) {
        put_back(turn, source);
        return;
    }
    if (source == MD_URGENT) {
        turn->urgent->is_done = turn->has_done_urgent = 1;
        turn->urgent = turn->urgent->next;
        return;
    }
    report(turn);
    if (source == MD_QUEUED) {
        md_store(&turn->progress.done, turn->progress.done + 1);
        uint32_t left = pending(turn);
        if (left == turn->room / 4 || left == 0)
            call(turn);
    } else if (turn->completion.result < 0 && !turn->completion.sent_ns) {
        stop_repeating(turn); /* otherwise the same exchange would fail again and again */
    }
}

/* Put the postponed exchange back into its queue, because a stop must not wait for it. */
static void give_way(struct md_turn *turn)
{
    int source = turn->source;
    md_line_put_back(&turn->line);
    turn->source = MD_NO_SOURCE;
    turn->miss_ns = 0; /* otherwise a stop's read would be taken again */
    put_back(turn, source);
}

int md_turn_want(struct md_turn *turn, int64_t *wake_ns, int64_t now_ns)
{
    struct md_line *line = &turn->line;
    for (;;) {
        if (turn->source == MD_NO_SOURCE && !take(turn, wake_ns, now_ns))
            return MD_DONE;
        if (md_line_is_postponed(line) && is_stop_waiting(turn)) {
            give_way(turn);
            continue;
        }
        int want = md_line_want(line, now_ns);
        if (want == MD_WRITE && is_overtaken(turn)) {
            md_line_abandon(line, MD_EXPIRED, 0);
            want = MD_DONE;
        }
        *wake_ns = line->wake_ns;
        if (want != MD_DONE)
            return want;
        settle(turn, now_ns - line->completion->begun_ns, now_ns);
        rest(line->exchange, line->completion, now_ns);
        finish(turn);
    }
}

void md_turn_lose(struct md_turn *turn, int error)
{
    int is_polled = turn->source == MD_QUEUED || turn->source == MD_REPEATED;
    int is_cut_off = is_polled && turn->line.is_proven && md_line_is_under_way(&turn->line);
    turn->progress.lost_error = error;
    md_store(&turn->progress.cut_off, (uint32_t)is_cut_off);
    md_store(&turn->progress.lost, 1);
    md_line_abandon(&turn->line, MD_LINE_LOST, error);
    if (is_cut_off && turn->source == MD_REPEATED)
        step_back(turn);
    stop_repeating(turn);
}

/* Waiting clients get a completion that shows whether their request left. A polled exchange that is ended
 * here still produces its rows. */
void md_turn_close(struct md_turn *turn)
{
    int is_reported = turn->source == MD_URGENT || turn->is_ending || turn->line.state == MD_IDLE;
    if (md_line_is_under_way(&turn->line) && md_is_command(turn->line.exchange))
        md_store(&turn->progress.called_off, 1);
    if (is_reported && turn->source != MD_NO_SOURCE) {
        md_line_abandon(&turn->line, turn->source == MD_URGENT ? MD_LINE_LOST : MD_POLL_ENDED, 0);
        finish(turn);
    }
    for (; turn->urgent; turn->urgent = turn->urgent->next) {
        *turn->urgent->completion = (struct md_completion){.result = MD_LINE_LOST};
        turn->urgent->is_done = turn->has_done_urgent = 1;
    }
}
