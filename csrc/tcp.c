/* Frames of Modbus TCP (messaging guide V1.0b): a stream, and whose replies they are.
 *
 * A reply has its request's transaction id: one with another id is late, or was never asked for here, and is
 * skipped. So no late reply can pass for another's, whatever it holds. Where a gateway replies with ids of
 * its own, the rules of late.c hold instead.
 *
 * A frame's length stands in its header alone. What is no header leaves no place to begin again: the
 * connection must be made anew. */
#include "line.h"

#include <string.h>

void md_tcp_begin(struct md_line *line)
{
    md_put16(line->long_tx, ++line->transaction);
}

/* ---- whole frames ---- */

size_t md_tcp_put(struct md_line *line, const uint8_t *bytes, size_t len)
{
    int whole = md_tcp_length(line->frame, line->frame_len);
    size_t wanted = (whole > 0 ? (size_t)whole : MD_TCP_HEAD) - line->frame_len;
    size_t taken = len < wanted ? len : wanted;
    memcpy(line->frame + line->frame_len, bytes, taken);
    line->frame_len = (uint16_t)(line->frame_len + taken);
    line->is_out_of_step = md_tcp_length(line->frame, line->frame_len) < 0;
    return taken;
}

static int is_ours(const struct md_line *line)
{
    return line->transactions == MD_IGNORED ||
           (line->frame_len >= 2 && md_get16(line->frame) == line->transaction);
}

/* Put what there is of a frame behind those that came before it, and report no byte of it twice. */
static size_t keep(struct md_line *line)
{
    if (line->rx_len + line->frame_len > MD_RX_ROOM) { /* frames that answer nothing, without end */
        md_tap_put(line->tap, MD_NOISE, line->completion->last_ns, line->rx, line->rx_len);
        line->rx_len = 0;
    }
    size_t at = line->rx_len;
    memcpy(line->rx + at, line->frame, line->frame_len);
    line->rx_len = (uint16_t)(at + line->frame_len);
    return at;
}

/* Be done with a frame that is part of no exchange. */
static void drop(struct md_line *line, int64_t now_ns)
{
    md_tap_put(line->tap, MD_NOISE, now_ns, line->frame + line->frame_told,
               (size_t)(line->frame_len - line->frame_told));
}

/* ---- late replies ---- */

/* When there are too many, every other one goes: of the earliest and of the latest some remain. */
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

/* The exchange under way is over, and its reply may still come. */
static void expect(struct md_line *line)
{
    if (line->transactions == MD_IGNORED)
        md_late_expect(line, md_window_ns(line->exchange));
    else
        remember(line);
}

/* This one and those before it are answered, or never will be. */
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
           !md_is_gateways(MD_TCP, &reply);
}

/* Learn how late a drive is, where the frame is a reply of its. */
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

/* ---- whose reply it is ---- */

/* It came while nothing is awaited. */
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
    if (used > 0 && md_is_gateways(MD_TCP, &reply)) { /* the drive said nothing, and may still say it */
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
    int whole = md_tcp_length(line->frame, line->frame_len);
    if (whole == MD_INCOMPLETE || (whole > 0 && line->frame_len < whole))
        return 0;
    if (is_awaited)
        line->completion->skipped += line->frame_len;
    if (is_awaited && (line->is_out_of_step || (is_ours(line) && !line->frame_told))) {
        size_t at = keep(line);
        is_end = !line->is_out_of_step && judge(line, at, now_ns, ending);
    } else if (is_awaited) {
        learn_late(line, now_ns);
        md_reply_extend(line);
        drop(line, now_ns);
        if (line->rx_len == 0) /* the reply's first byte is still to come */
            line->completion->first_ns = 0;
    } else {
        pass(line, now_ns);
    }
    line->frame_len = line->frame_told = 0;
    return is_end;
}

/* ---- no reply ---- */

struct md_ending md_tcp_missed(struct md_line *line)
{
    const struct md_exchange *exchange = line->exchange;
    if (line->frame_len && !line->frame_told && is_ours(line)) {
        keep(line);
        line->frame_told = line->frame_len;
    }
    expect(line);
    md_learn_silence(exchange->drive);
    int reason = md_reason(MD_TCP, &exchange->request, line->rx, line->rx_len);
    return (struct md_ending){reason, 0, line->rx_len};
}
