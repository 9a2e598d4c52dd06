/* The requests that clients put before a line: queued, repeated and urgent ones. */
#include "turn.h"

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
    if (*at && turn->whose == MD_URGENT) /* it is under way */
        at = &(*at)->next;
    for (struct md_urgent **waiting = at; *waiting; waiting = &(*waiting)->next)
        if (!urgent->exchange->insists || (*waiting)->exchange->insists) /* the first one goes first */
            at = &(*waiting)->next;
    urgent->next = *at;
    *at = urgent;
}

void md_turn_tell_echo(struct md_turn *turn, int echo)
{
    turn->line.echo = (uint8_t)echo;
    turn->line.echo_is_told = echo == MD_ECHO; /* an echo that shows is believed: it confirms no write */
    md_store(&turn->progress.echo, (uint32_t)echo);
}

int md_turn_end(struct md_turn *turn)
{
    turn->is_ending = 1;
    int is_waiting = turn->whose == MD_NOBODYS || md_listen_is_held(&turn->line);
    return !is_waiting && turn->whose != MD_URGENT;
}

/* What an exchange needs of the line begins with the silence before it, and never before the line's last
 * activity (measure() in reply.c). */
int64_t md_turn_counted_ns(const struct md_turn *turn, int64_t now_ns)
{
    const struct md_line *line = &turn->line;
    if (md_line_is_under_way(line))
        return line->completion->sent_ns - line->silence_ns;
    return sooner(now_ns, later(line->quiet_ns, now_ns - line->silence_ns));
}

int md_turn_is_asking(const struct md_turn *turn, const struct md_drive *drive)
{
    if (turn->whose != MD_NOBODYS && turn->line.exchange->drive == drive)
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
