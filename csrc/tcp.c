/* Modbus TCP (messaging guide V1.0b): frames from a stream, and the matching of replies.
 *
 * A reply repeats its request's transaction id. A frame with another id is late or foreign and is skipped, so
 * no late reply can be mistaken for the reply to another request. If a gateway replies with its own ids, the
 * rules of late.c apply instead.
 *
 * Only the header gives a frame's length. If a device sends more or fewer bytes, the header of the awaited
 * reply is found by its id, unit and function. If the first bytes on a port are not a header, the far end
 * speaks another protocol, and the port is given up. */
#include "line.h"

#include <string.h>

void md_tcp_begin(struct md_line *line)
{
    md_put16(line->long_tx, ++line->transaction);
}

/* ---- whole frames ---- */

enum { KNOWN_HEAD = MD_TCP_HEAD + 2 /* the header, the unit id and the function code */ };

static int is_ours(const struct md_line *line)
{
    return line->transactions == MD_IGNORED ||
           (line->frame_len >= 2 && md_get16(line->frame) == line->transaction);
}

/* Return 1 if these bytes may start the awaited reply, whatever length they announce. */
static int may_be_awaited(const struct md_line *line, const uint8_t *bytes, size_t len)
{
    if (line->state < MD_AWAITING)
        return 0;
    const struct md_message *request = &line->exchange->request;
    uint8_t any_id = line->transactions == MD_IGNORED ? 0xFF : 0;
    uint8_t head[KNOWN_HEAD] = {(uint8_t)(line->transaction >> 8), (uint8_t)line->transaction,
                                [MD_TCP_HEAD] = request->address, request->function};
    const uint8_t any[KNOWN_HEAD] = {any_id, any_id, 0, 0, 0xFF, 0xFF, 0, MD_EXCEPTION_BIT};
    for (size_t i = 0; i < len && i < KNOWN_HEAD; i++)
        if ((bytes[i] ^ head[i]) & ~any[i])
            return 0;
    return 1;
}

/* Return the length of the current frame, like md_tcp_length(). If the frame may be the awaited reply, do not
 * trust its header: return the fixed length for an exception, and KNOWN_HEAD for an impossible length. */
static int frame_length(const struct md_line *line)
{
    int whole = md_tcp_length(line->frame, line->frame_len);
    if (line->frame_tapped || line->frame_len < MD_TCP_HEAD ||
        !may_be_awaited(line, line->frame, line->frame_len))
        return whole;
    if (md_tcp_is_exception(line->frame, line->frame_len, &line->exchange->request))
        return MD_TCP_EXCEPTION;
    return line->frame_len < KNOWN_HEAD || whole < 0 ? KNOWN_HEAD : whole;
}

/* Pass bytes outside of frames to the tap, and count them. */
static void skip(struct md_line *line, const uint8_t *bytes, size_t len, int64_t now_ns)
{
    md_tap_put(line->tap, MD_NOISE, now_ns, bytes, len);
    if (line->state >= MD_AWAITING)
        line->completion->skipped += (uint32_t)len;
    else if (line->state != MD_IDLE)
        line->completion->stale += (uint32_t)len;
}

static void cut_off(struct md_line *line, size_t len)
{
    line->frame_len = (uint16_t)(line->frame_len - len);
    memmove(line->frame, line->frame + len, line->frame_len);
}

/* Drop all bytes before a possible start of the awaited reply. */
static void realign(struct md_line *line, int64_t now_ns)
{
    cut_off(line, line->frame_tapped);
    line->frame_tapped = 0;
    while (line->frame_len && !may_be_awaited(line, line->frame, line->frame_len)) {
        skip(line, line->frame, 1, now_ns);
        cut_off(line, 1);
    }
}

/* Take bytes up to the header of the awaited reply. */
static size_t seek(struct md_line *line, const uint8_t *bytes, size_t len, int64_t now_ns)
{
    size_t taken = 0;
    if (line->state < MD_AWAITING) {
        skip(line, bytes, len, now_ns);
        return len;
    }
    while (taken < len && line->frame_len < KNOWN_HEAD) {
        line->frame[line->frame_len++] = bytes[taken++];
        realign(line, now_ns);
    }
    line->is_adrift = line->frame_len < KNOWN_HEAD;
    return taken;
}

static void drop(struct md_line *line, int64_t now_ns)
{
    md_tap_put(line->tap, MD_NOISE, now_ns, line->frame + line->frame_tapped,
               (size_t)(line->frame_len - line->frame_tapped));
    line->frame_len = line->frame_tapped = 0;
}

void md_tcp_disown(struct md_line *line)
{
    size_t untapped = (size_t)(line->frame_len - line->frame_tapped);
    md_tap_put(line->tap, MD_NOISE, line->completion->sent_ns, line->frame + line->frame_tapped, untapped);
    line->completion->stale += (uint32_t)untapped;
    line->frame_tapped = line->frame_len;
    line->is_adrift |= line->frame_len > 0;
}

size_t md_tcp_put(struct md_line *line, const uint8_t *bytes, size_t len, int64_t now_ns)
{
    size_t enough = line->transactions == MD_IGNORED ? KNOWN_HEAD : MD_TCP_HEAD;
    if (line->is_adrift && line->frame_tapped && len >= enough && may_be_awaited(line, bytes, len))
        drop(line, now_ns); /* the rest of the frame did not come */
    if (line->is_adrift && !line->frame_tapped)
        return seek(line, bytes, len, now_ns);
    int whole = frame_length(line);
    size_t end = whole > 0 ? (size_t)whole : MD_TCP_HEAD;
    size_t wanted = end > line->frame_len ? end - line->frame_len : 0, taken = len < wanted ? len : wanted;
    memcpy(line->frame + line->frame_len, bytes, taken);
    line->frame_len = (uint16_t)(line->frame_len + taken);
    if (frame_length(line) >= 0)
        return taken;
    line->is_adrift |= line->is_proven;
    line->is_out_of_step = !line->is_adrift;
    if (line->is_adrift)
        realign(line, now_ns);
    return taken;
}

/* Append the current frame to rx and return its index in rx. Do not pass a byte to the tap twice. */
static size_t keep(struct md_line *line)
{
    if (line->rx_len + line->frame_len > MD_RX_ROOM) { /* discard frames that were not replies */
        md_tap_put(line->tap, MD_NOISE, line->completion->last_ns, line->rx, line->rx_len);
        line->rx_len = 0;
    }
    size_t at = line->rx_len;
    memcpy(line->rx + at, line->frame, line->frame_len);
    line->rx_len = (uint16_t)(at + line->frame_len);
    return at;
}

/* ---- late replies ---- */

/* Add the request to the drive's outstanding requests. When the list is full, drop every second request, so
 * that both old and new ones remain. */
static void remember(struct md_line *line)
{
    struct md_drive *drive = line->exchange->drive;
    struct md_unanswered *unanswered = drive->history->unanswered;
    if (drive->unanswered_count == MD_MOST_OWED) {
        for (uint32_t i = 0; i < MD_MOST_OWED / 2; i++)
            unanswered[i] = unanswered[2 * i];
        drive->unanswered_count = MD_MOST_OWED / 2;
    }
    unanswered[drive->unanswered_count++] =
        (struct md_unanswered){.sent_ns = line->quiet_ns, .transaction = line->transaction,
                               .address = line->exchange->request.address};
    md_late_link(line, drive);
}

static void expect(struct md_line *line)
{
    if (line->transactions == MD_IGNORED)
        md_late_expect(line, md_window_ns(line->exchange));
    else
        remember(line);
}

/* Drop this request and all earlier ones: no further reply to them will come. */
static void forget_up_to(struct md_drive *drive, uint32_t last)
{
    struct md_unanswered *unanswered = drive->history->unanswered;
    drive->unanswered_count -= last + 1;
    memmove(unanswered, unanswered + last + 1, drive->unanswered_count * sizeof *unanswered);
}

static int is_reply_to(const struct md_line *line, const struct md_unanswered *unanswered)
{
    enum { EXCEPTION_AT = MD_TCP_HEAD + 2 };
    const uint8_t *body = line->frame + MD_TCP_HEAD;
    struct md_message reply = {0};
    if (line->frame_len > EXCEPTION_AT && (body[1] & MD_EXCEPTION_BIT))
        reply.exception = body[2];
    return md_get16(line->frame) == unanswered->transaction && body[0] == unanswered->address &&
           !md_is_from_gateway(MD_TCP, &reply);
}

/* If the frame is a drive's late reply, learn how late it is. */
static void learn_late(struct md_line *line, int64_t now_ns)
{
    for (struct md_drive **link = &line->late; *link;) {
        struct md_drive *drive = *link;
        for (uint32_t i = 0; i < drive->unanswered_count; i++) {
            if (!is_reply_to(line, &drive->history->unanswered[i]))
                continue;
            drive->history->late++;
            md_count_failures(drive, 0);
            md_learn_lateness(drive, now_ns - drive->history->unanswered[i].sent_ns, 1);
            forget_up_to(drive, i);
            return;
        }
        if (drive->unanswered_count)
            link = &drive->next_late;
        else
            *link = drive->next_late;
    }
}

/* ---- matching ---- */

/* Process a frame that came while no reply is due. */
static void pass(struct md_line *line, int64_t now_ns)
{
    if (line->state != MD_IDLE)
        line->completion->stale += line->frame_len;
    if (line->transactions == MD_MATCHED) {
        learn_late(line, now_ns);
    } else if (line->late) {
        line->rx_len = 0;
        keep(line);
        md_late_take(line, 0, now_ns, NULL);
        line->rx_len = 0;
    }
    drop(line, now_ns);
}

static int judge(struct md_line *line, size_t at, int64_t now_ns, struct md_ending *ending)
{
    struct md_message reply;
    int used = md_reply_parse(line, at, &reply);
    int is_odd = used > 0 ? used != md_tcp_length(line->frame, line->frame_len)
                          : used == MD_BAD_LENGTH || used == MD_NO_START;
    line->is_adrift |= (uint8_t)is_odd;
    line->is_proven |= used > 0;
    /* a gateway's exception: the drive itself may still answer */
    if (used > 0 && md_is_from_gateway(MD_TCP, &reply)) {
        expect(line);
        *ending = (struct md_ending){MD_NO_REPLY, at, line->frame_len};
        return 1;
    }
    if (used > 0 && line->transactions == MD_IGNORED)
        return md_reply_judge(line, at, used, &reply, now_ns, ending);
    if (used > 0) {
        md_reply_accept(line, at, used, &reply);
        *ending = (struct md_ending){used, at, (size_t)used};
        return 1;
    }
    if (line->transactions == MD_IGNORED && md_late_take(line, at, now_ns, NULL) > 0) {
        md_reply_extend(line);
        md_reply_cut_out(line, at, line->frame_len);
    }
    return 0;
}

int md_tcp_find(struct md_line *line, int64_t now_ns, struct md_ending *ending)
{
    int is_awaited = line->state >= MD_AWAITING, is_end = 0;
    int whole = frame_length(line);
    if (line->is_adrift && !line->frame_tapped)
        return 0;
    if (whole == MD_INCOMPLETE || (whole > 0 && line->frame_len < whole))
        return 0;
    if (is_awaited)
        line->completion->skipped += line->frame_len;
    if (is_awaited && (line->is_out_of_step || (is_ours(line) && !line->frame_tapped))) {
        size_t at = keep(line);
        is_end = !line->is_out_of_step && judge(line, at, now_ns, ending);
    } else if (is_awaited) {
        learn_late(line, now_ns);
        md_reply_extend(line);
        drop(line, now_ns);
        if (line->rx_len == 0) /* no byte of the reply has come */
            line->completion->first_ns = 0;
    } else {
        pass(line, now_ns);
        line->is_adrift = 0;
    }
    line->frame_len = line->frame_tapped = 0;
    return is_end;
}

/* ---- no reply ---- */

struct md_ending md_tcp_missed(struct md_line *line)
{
    const struct md_exchange *exchange = line->exchange;
    if (line->frame_len && !line->frame_tapped && is_ours(line)) {
        keep(line);
        line->frame_tapped = line->frame_len;
    }
    line->is_adrift |= line->frame_len > 0;
    expect(line);
    md_learn_silence(exchange->drive);
    int reason = md_reason(MD_TCP, &exchange->request, line->rx, line->rx_len);
    return (struct md_ending){reason, 0, line->rx_len};
}
