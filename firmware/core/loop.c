// SPDX-License-Identifier: Apache-2.0

#include "loop.h"

/* Bytes sent at a time: their room in the output is free again only when all of them are sent.
 * Chosen: 1/24 of the RP2040's output ring, 64 USB packets. */
#define PIECE 4096u
/* Time after which a host that takes nothing gets, once it does, what is new rather than what waits. Chosen:
 * the RP2040's output ring holds 0.6 s of the usual 80 kS/s. */
#define STALE_US 500000u

static const uint8_t delimiter = 0;

static void hear(struct dg_loop *loop, const struct dg_link *link, const uint8_t *bytes,
                 size_t size)
{
    struct dg *dg = loop->dg;
    uint64_t now_us = loop->hardware->time_us();

    dg_time(dg, now_us);
    uint16_t next = dg->writer.sequence;
    if (link != loop->heard)
        dg_receive(dg, &delimiter, 1, now_us); /* ends the other link's unfinished packet */
    loop->heard = link;
    dg_receive(dg, bytes, size, now_us);
    if (dg->writer.sequence != next) /* a command was answered */
        loop->commander = link;
}

static void receive(struct dg_loop *loop)
{
    const struct dg_hardware *hardware = loop->hardware;
    uint8_t bytes[128];
    size_t size;

    for (const struct dg_link *link = hardware->links;
         link != hardware->links + hardware->link_count; link++)
        while ((size = link->read(bytes, sizeof bytes)))
            hear(loop, link, bytes, size);
}

/* Returns the number of samples passed on. */
static size_t pass_samples(struct dg_loop *loop)
{
    const uint16_t *counts;
    uint32_t lost;
    size_t size = loop->hardware->take_samples(&counts, &lost);

    if (lost)
        dg_lost(loop->dg, lost);
    dg_samples(loop->dg, counts, size);
    loop->hardware->release_samples(size);
    return size;
}

/* After a missed pulse the nodes' timing no longer matches the samples: sends what was sampled until
 * then and begins a new stream. */
static void recover_pulses(struct dg_loop *loop)
{
    loop->hardware->pause_samples();
    while (pass_samples(loop))
        ;
    dg_end(loop->dg);
    dg_sync_fault(loop->dg);
    loop->hardware->restart(loop->dg);
}

static const struct dg_link *output_link(const struct dg_loop *loop)
{
    const struct dg_link *link = loop->hardware->links, *last = link + loop->hardware->link_count - 1;

    if (loop->commander)
        return loop->commander;
    while (link != last && !link->ready())
        link++;
    return link;
}

static void send(struct dg_loop *loop)
{
    const struct dg_link *next = output_link(loop);
    bool ready = next->ready();
    uint64_t now_us = loop->hardware->time_us();
    const uint8_t *bytes;

    if (loop->carrier && !(loop->carrier == next && ready)) { /* its host may have stopped reading for good */
        size_t left = loop->carrier->cancel();
        /* what is left may be the delimiter, which is not of the output */
        loop->in_flight = loop->in_flight > left ? loop->in_flight - left : 0;
    }
    if (loop->carrier && loop->carrier->sending()) {
        if (now_us - loop->since_us > STALE_US)
            dg_drop(loop->dg, loop->in_flight);
        return;
    }
    dg_sent(loop->dg, loop->in_flight);
    loop->in_flight = 0;
    loop->since_us = now_us;
    if (!ready) {
        loop->carrier = NULL;
        dg_sent(loop->dg, loop->dg->writer.used);
        return;
    }
    if (loop->carrier != next) {
        loop->carrier = next;
        next->send(&delimiter, 1); /* ends the packet that was cut when this link was left */
        return;
    }
    loop->in_flight = dg_output(loop->dg, &bytes);
    if (loop->in_flight > PIECE)
        loop->in_flight = PIECE;
    next->send(bytes, loop->in_flight);
}

void dg_loop_init(struct dg_loop *loop, struct dg *dg, const struct dg_hardware *hardware)
{
    *loop = (struct dg_loop){.dg = dg, .hardware = hardware};
}

void dg_loop_pass(struct dg_loop *loop)
{
    receive(loop);
    if (loop->dg->running && loop->commander && !loop->commander->ready())
        dg_stop(loop->dg);
    if (dg_restarted(loop->dg))
        loop->hardware->restart(loop->dg);
    if (loop->dg->running && (loop->hardware->pulses_failed() || dg_strayed(loop->dg)))
        recover_pulses(loop);
    bool more = loop->dg->running && pass_samples(loop) == DG_CHUNK;
    dg_time(loop->dg, loop->hardware->time_us());
    send(loop);
    if (!more)
        loop->hardware->sleep();
}
