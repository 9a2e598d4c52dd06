/* Replies after their timeout: no late reply is ever mistaken for the reply to another request.
 *
 * A drive that is a little late may answer in any order. For some time after a timeout (the window), a
 * request is not sent if a late reply could be mistaken for its reply.
 *
 * A path that delays all bytes (a modem, a gateway, a stalled network) keeps their order. A reply that fits
 * no outstanding request shows that all earlier replies have come, or never will. Therefore outstanding
 * requests are kept beyond the window, and a proof is sent before a new request. A proof is a read whose
 * reply differs from all outstanding replies in function, length or value.
 *
 * A reply that fits an outstanding request counts as the reply to that request. It settles the earliest
 * request that it fits, and all requests sent before that request. */
#include "line.h"

#include <string.h>

/* ---- an outstanding request: one whose reply may still come ---- */

enum { DATA_KEPT = sizeof((struct md_owed){0}.data), LAST_READ = 0x04 };

static uint8_t data_kept(const struct md_message *request)
{
    return (uint8_t)(request->data_len < DATA_KEPT ? request->data_len : DATA_KEPT);
}

static struct md_owed owed_of(const struct md_exchange *exchange)
{
    const struct md_message *request = &exchange->request;
    struct md_owed owed = {.framing = (uint8_t)exchange->framing, .address = request->address,
                           .function = request->function, .start = request->start, .count = request->count,
                           .reply_len = (uint16_t)md_reply_length(exchange->framing, request),
                           .least = exchange->least, .end = exchange->end,
                           .data_len = data_kept(request)};
    memcpy(owed.data, request->data, owed.data_len);
    return owed;
}

static int is_same(const struct md_owed *owed, const struct md_exchange *exchange)
{
    const struct md_message *request = &exchange->request;
    return owed->framing == exchange->framing && owed->function == request->function &&
           owed->start == request->start && owed->count == request->count &&
           owed->least == exchange->least && owed->end == exchange->end &&
           memcmp(owed->data, request->data, data_kept(request)) == 0;
}

/* Return 1 unless the ranges of the two replies exclude each other: then their values differ. */
static int may_hold_the_same(const struct md_owed *owed, const struct md_exchange *exchange)
{
    return !owed->end || !exchange->end || (owed->least < exchange->end && exchange->least < owed->end);
}

int md_is_read(int framing, uint8_t function)
{
    if (framing == MD_DELIXI)
        return function == MD_DELIXI_STATE_QUERY || function == MD_DELIXI_PARAMETER_QUERY;
    return function <= LAST_READ || function == MD_READ_STATUS || function == MD_REPORT_ID ||
           function == MD_READ_IDENTITY;
}

/* Return 1 if a reply to the outstanding request could be mistaken for the exchange's reply. Exceptions count
 * too, because they do not name the write that they refuse: a start could be reported as refused while the
 * motor runs. */
static int is_mistakable(const struct md_owed *owed, const struct md_exchange *exchange)
{
    const struct md_message *request = &exchange->request;
    if (owed->framing != exchange->framing)
        return 0;
    if (!md_is_read(exchange->framing, request->function))
        return exchange->framing == MD_DELIXI || owed->function == request->function;
    if (owed->function != request->function)
        return 0;
    if (exchange->framing == MD_DELIXI)
        return owed->start == request->start || owed->function == MD_DELIXI_STATE_QUERY;
    return owed->reply_len == md_reply_length(exchange->framing, request) &&
           may_hold_the_same(owed, exchange);
}

int md_is_in_range(const struct md_message *reply, uint16_t least, uint32_t end)
{
    uint32_t value = md_get16(reply->data);
    return end == 0 || reply->exception || reply->data_len < 2 || (value >= least && value < end);
}

/* Parse `bytes` as the reply to `owed`. Return the reply's length or an enum md_frame_fault. */
static int parse_owed(const struct md_owed *owed, const uint8_t *bytes, size_t len)
{
    struct md_message request = {.address = owed->address, .function = owed->function, .start = owed->start,
                                 .count = owed->count, .data_len = owed->data_len};
    struct md_message reply;
    memcpy(request.data, owed->data, owed->data_len);
    if (owed->framing == MD_RTU && bytes[0] != owed->address)
        return MD_BAD_ADDRESS;
    int used = md_parse_reply(owed->framing, bytes, len, &request, &reply);
    return used > 0 && !md_is_in_range(&reply, owed->least, owed->end) ? MD_BAD_ECHO : used;
}

static uint32_t last_place(const struct md_owed *owed)
{
    return (owed->times < MD_TIMES_KEPT ? owed->times : MD_TIMES_KEPT) - 1;
}

static int64_t last_ns(const struct md_owed *owed)
{
    return owed->sent_ns[last_place(owed)];
}

static void add_time(struct md_owed *owed, int64_t sent_ns)
{
    if (owed->times >= MD_TIMES_KEPT)
        memmove(owed->sent_ns + 1, owed->sent_ns + 2, (MD_TIMES_KEPT - 2) * sizeof *owed->sent_ns);
    owed->times++;
    owed->sent_ns[last_place(owed)] = sent_ns;
}

static void drop_time(struct md_owed *owed)
{
    if (owed->times-- <= MD_TIMES_KEPT)
        memmove(owed->sent_ns, owed->sent_ns + 1, (MD_TIMES_KEPT - 1) * sizeof *owed->sent_ns);
}

/* ---- proofs ---- */

/* Some proofs may not work: a device may be silent to registers that it lacks, and a document may be wrong
 * about a register's range. A proof that was never answered is removed after MOST_FAILURES failures. A
 * missing reply counts as a failure only if the drive has replied to another request since the last
 * failure. */
enum { MOST_FAILURES = 2, ANSWERED = 0xFF };

/* Return the index of this exchange in the drive's list of proofs, or proof_count if it is not a proof.
 * Usually it is not, and the list is not read, because its memory is rarely cached. */
static uint32_t proof_at(const struct md_exchange *exchange)
{
    const struct md_drive *drive = exchange->drive;
    uint32_t at = exchange->is_proof ? 0 : drive->proof_count;
    while (at < drive->proof_count && drive->proofs[at] != exchange)
        at++;
    return at;
}

int md_proof_is(const struct md_exchange *exchange)
{
    return proof_at(exchange) < exchange->drive->proof_count;
}

/* Remove a proof. If only one proof is left, remove it too: a late reply to it would look like a new one. */
static void drop_proof(struct md_drive *drive, uint32_t at)
{
    drive->proof_count--;
    for (; at < drive->proof_count; at++) {
        drive->proofs[at] = drive->proofs[at + 1];
        drive->proof_failures[at] = drive->proof_failures[at + 1];
    }
    if (drive->proof_count == 1)
        drive->proof_count = 0;
}

void md_proof_end(const struct md_exchange *exchange, int result)
{
    struct md_drive *drive = exchange->drive;
    uint32_t at = proof_at(exchange);
    if (at == drive->proof_count || drive->proof_failures[at] == ANSWERED)
        return;
    uint64_t replies = md_replies(drive);
    int is_silent_to_it = result == MD_NO_REPLY && replies != drive->failed_at;
    if (result > 0)
        drive->proof_failures[at] = ANSWERED;
    if (!is_silent_to_it && result != MD_BAD_ECHO) /* MD_BAD_ECHO: value outside the proof's range */
        return;
    drive->failed_at = replies;
    if (++drive->proof_failures[at] == MOST_FAILURES)
        drop_proof(drive, at);
}

static void note_late_proof(struct md_drive *drive, const struct md_owed *owed)
{
    for (uint32_t i = 0; i < MD_MOST_PROOFS && i < drive->proof_count; i++)
        if (is_same(owed, drive->proofs[i]))
            drive->proof_failures[i] = ANSWERED;
}

/* ---- outstanding requests of a drive ---- */

/* ns; older requests are forgotten, because no network delays bytes by 2 minutes */
static const int64_t FORGET_NS = INT64_C(120000000000);

/* Return the drive's outstanding request that is the same as the exchange's request; NULL: none. */
static struct md_owed *find_same(struct md_drive *drive, const struct md_exchange *exchange)
{
    for (uint32_t i = 0; i < drive->owed_count; i++)
        if (is_same(&drive->history->owed[i], exchange))
            return &drive->history->owed[i];
    return NULL;
}

int md_late_is_repeated(const struct md_exchange *exchange)
{
    return find_same(exchange->drive, exchange) != NULL;
}

/* Return 1 unless a reply to a later request has settled this request. */
static int is_open(const struct md_drive *drive, const struct md_owed *owed)
{
    return last_ns(owed) > drive->answered_ns;
}

static void drop(struct md_drive *drive, struct md_owed *owed)
{
    *owed = drive->history->owed[--drive->owed_count];
}

static void forget_settled(struct md_drive *drive, int64_t now_ns)
{
    for (uint32_t i = drive->owed_count; i-- > 0;) {
        struct md_owed *owed = &drive->history->owed[i];
        int is_over = now_ns >= drive->late_until_ns && (!is_open(drive, owed) || drive->proof_count == 0);
        if (is_over || now_ns - last_ns(owed) > FORGET_NS)
            drop(drive, owed);
    }
}

/* ---- requests that may be sent ---- */

/* Return 1 if an outstanding reply could be mistaken for the exchange's reply. Outstanding replies to the
 * same request count only if `own` is 1. */
static int has_mistakable(const struct md_exchange *exchange, int own)
{
    const struct md_drive *drive = exchange->drive;
    /* the last places are reserved for proofs */
    int is_crowded = drive->owed_count > MD_MOST_OWED - MD_MOST_PROOFS;
    for (uint32_t i = 0; i < drive->owed_count; i++) {
        const struct md_owed *owed = &drive->history->owed[i];
        int counts = is_open(drive, owed) && (own || !is_same(owed, exchange));
        if (counts && (is_crowded || is_mistakable(owed, exchange)))
            return 1;
    }
    return 0;
}

/* Return 1 if a late exception within the window could be mistaken for the exchange's reply: an exception
 * names only the function, with Delixi not even that. */
static int is_in_window(const struct md_exchange *exchange, int64_t now_ns)
{
    const struct md_drive *drive = exchange->drive;
    if (now_ns >= drive->late_until_ns)
        return 0;
    for (uint32_t i = 0; i < drive->owed_count; i++)
        if (exchange->framing == MD_DELIXI || drive->history->owed[i].function == exchange->request.function)
            return 1;
    return 0;
}

/* Return 1 if the request does not wait for late replies: a stop must leave, and a broadcast has no reply. */
static int is_exempt(const struct md_exchange *exchange)
{
    return exchange->insists || md_reply_length(exchange->framing, &exchange->request) == 0;
}

static int is_doubted(const struct md_exchange *exchange)
{
    const struct md_drive *drive = exchange->drive;
    return drive->is_doubted && drive->proof_count && !is_exempt(exchange);
}

/* An exception is never in doubt here: it carries no value and settles no request. */
int md_late_is_in_doubt(const struct md_exchange *exchange, const struct md_message *reply)
{
    return is_doubted(exchange) && !reply->exception &&
           md_is_read(exchange->framing, exchange->request.function);
}

static int is_first_write(const struct md_exchange *exchange)
{
    return is_doubted(exchange) && exchange->drive->answered_ns == 0 &&
           !md_is_read(exchange->framing, exchange->request.function);
}

int md_late_bars(const struct md_exchange *exchange, int64_t now_ns)
{
    struct md_drive *drive = exchange->drive;
    if (is_first_write(exchange))
        return 1;
    if (drive->owed_count == 0 || is_exempt(exchange))
        return 0;
    if (is_in_window(exchange, now_ns))
        return 1;
    forget_settled(drive, now_ns);
    return !md_proof_is(exchange) && has_mistakable(exchange, 0);
}

/* Return the proof that is not sent while the drive is silent, only once it answers again. As it was not sent
 * during the silence, at the latest the second reply to it settles all outstanding requests. */
static const struct md_exchange *last_proof(const struct md_drive *drive)
{
    return drive->proof_count ? drive->proofs[drive->proof_count - 1] : NULL;
}

/* Return 1 if a request to a silent drive needs no proof, because any reply shows that the drive is back. */
static int is_sent_alone(const struct md_exchange *exchange)
{
    const struct md_exchange *last = last_proof(exchange->drive);
    struct md_owed own = owed_of(exchange);
    return exchange->drive->failures > 0 && !has_mistakable(exchange, 0) &&
           (!last || !is_mistakable(&own, last));
}

static int is_free(const struct md_drive *drive, const struct md_exchange *proof)
{
    for (uint32_t i = 0; i < drive->owed_count; i++) {
        const struct md_owed *owed = &drive->history->owed[i];
        if (is_open(drive, owed) && is_mistakable(owed, proof))
            return 0;
    }
    return 1;
}

/* Return the time at which the proof was last sent; 0: it is not outstanding. */
static int64_t sent_last_ns(struct md_drive *drive, const struct md_exchange *proof)
{
    const struct md_owed *owed = find_same(drive, proof);
    return owed ? last_ns(owed) : 0;
}

const struct md_exchange *md_late_proof(const struct md_exchange *exchange, int64_t now_ns)
{
    struct md_drive *drive = exchange->drive;
    if (is_first_write(exchange))
        return last_proof(drive);
    if (drive->owed_count == 0 || is_exempt(exchange) || is_in_window(exchange, now_ns))
        return NULL;
    forget_settled(drive, now_ns);
    if (!has_mistakable(exchange, 1) || is_sent_alone(exchange))
        return NULL;
    int is_answering = drive->failures == 0;
    const struct md_exchange *latest = NULL;
    for (uint32_t n = 0; n + !is_answering < drive->proof_count; n++) {
        const struct md_exchange *proof = drive->proofs[n];
        if (is_free(drive, proof))
            return proof;
        /* the proof that was sent last settles most requests */
        if (!latest || sent_last_ns(drive, proof) > sent_last_ns(drive, latest))
            latest = proof;
    }
    return is_answering ? last_proof(drive) : latest;
}

/* ---- add and settle outstanding requests ---- */

void md_late_link(struct md_line *line, struct md_drive *drive)
{
    for (const struct md_drive *owing = line->late; owing; owing = owing->next_late)
        if (owing == drive)
            return;
    drive->next_late = line->late;
    line->late = drive;
}

static struct md_owed *place_of(struct md_drive *drive, const struct md_exchange *exchange)
{
    struct md_owed *owed = find_same(drive, exchange);
    if (!owed && drive->owed_count < MD_MOST_OWED) {
        owed = &drive->history->owed[drive->owed_count++];
        *owed = owed_of(exchange);
    }
    return owed;
}

void md_late_expect(struct md_line *line, int64_t window_ns)
{
    const struct md_exchange *exchange = line->exchange;
    struct md_drive *drive = exchange->drive;
    int64_t reply_ns = md_longest_reply(exchange->framing, &exchange->request) * exchange->character_ns;
    int64_t until_ns = window_ns ? line->quiet_ns + window_ns + reply_ns : 0;
    forget_settled(drive, line->quiet_ns);
    struct md_owed *owed = place_of(drive, exchange);
    if (owed)
        add_time(owed, line->quiet_ns);
    drive->late_until_ns = later(until_ns, drive->late_until_ns);
    md_late_link(line, drive);
}

void md_late_doubt(struct md_line *line)
{
    struct md_drive *drive = line->exchange->drive;
    md_late_expect(line, 0);
    struct md_owed *owed = find_same(drive, line->exchange);
    if (owed)
        owed->is_doubtful = 1;
    drive->is_doubted = 0;
    drive->doubtful++;
    md_count_failures(drive, 0);
}

void md_late_inherit(struct md_drive *drive, const struct md_drive *before)
{
    int is_known = drive->owed_count > 0 && before->late_until_ns <= drive->late_until_ns;
    if (drive == before || before->owed_count == 0 || is_known)
        return;
    drive->owed_count = before->owed_count;
    memcpy(drive->history->owed, before->history->owed, sizeof drive->history->owed);
    drive->late_until_ns = before->late_until_ns;
    drive->answered_ns = before->answered_ns;
}

/* ---- late replies ---- */

/* Settle the drive's earliest request that the reply at `at` fits; return the reply's length, MD_INCOMPLETE
 * or MD_NO_START. A reply that fits a single old request shows how late the drive is. */
static int take_of(struct md_drive *drive, struct md_line *line, size_t at, int64_t now_ns, int64_t *since_ns)
{
    struct md_owed *earliest = NULL;
    int found = MD_NO_START, length = 0, fits = 0;
    for (uint32_t i = 0; i < drive->owed_count; i++) {
        struct md_owed *owed = &drive->history->owed[i];
        int used = parse_owed(owed, line->rx + at, line->rx_len - at);
        if (used == MD_INCOMPLETE)
            found = used;
        fits += used > 0;
        if (used > 0 && (!earliest || owed->sent_ns[0] < earliest->sent_ns[0])) {
            earliest = owed;
            length = used;
        }
    }
    if (!earliest)
        return found;
    if (earliest->is_doubtful)
        drive->doubtful++;
    else
        drive->history->late++;
    note_late_proof(drive, earliest);
    md_count_failures(drive, 0);
    drive->answered_ns = later(drive->answered_ns, earliest->sent_ns[0] - 1);
    if (since_ns)
        *since_ns = is_same(earliest, line->exchange) ? earliest->sent_ns[0] : 0;
    else if (fits == 1)
        md_learn_lateness(drive, now_ns - last_ns(earliest), earliest->times == 1);
    drop_time(earliest);
    if (earliest->times == 0)
        drop(drive, earliest);
    if (drive->owed_count == 0)
        drive->late_until_ns = 0;
    return length;
}

int md_late_take(struct md_line *line, size_t at, int64_t now_ns, int64_t *since_ns)
{
    int found = MD_NO_START;
    for (struct md_drive **link = &line->late; *link;) {
        struct md_drive *drive = *link;
        forget_settled(drive, now_ns);
        if (drive->owed_count == 0) {
            *link = drive->next_late;
            continue;
        }
        int used = take_of(drive, line, at, now_ns, since_ns);
        if (used > 0)
            return used;
        if (used == MD_INCOMPLETE)
            found = used;
        link = &drive->next_late;
    }
    return found;
}
