// SPDX-License-Identifier: Apache-2.0

/* The emulated skin: nodes, their sync line and the analog line that they share.
 *
 *     volts(t) = offset + polarity · Σ gain · level(t) · supply / 2  + noise, clipped at the rails
 *
 * with level +1, −1 or 0 (released), for a summing amplifier whose summing point holds a released
 * input at half its supply. Without an amplifier the nodes' resistors load the line:
 *
 *     volts(t) = offset + Σ gain · (level(t) · supply / 2 + supply / 2 − offset) / (load + Σ gain) + noise
 *
 * over the nodes that drive it, with gain the conductance of their resistors.
 *
 * On the data wire an edge of the sync line up pulls the line low, and volts(t) to pulled_v; after the edge down
 * it comes back, by exp(-t / recovery). */
#ifndef SKIN_H
#define SKIN_H

#include "avr_node.h"

struct amplifier {
    double offset_v;
    double polarity;       /* +1, or −1 where it inverts */
    double low_v, high_v;  /* its rails */
    double noise_v;        /* standard deviation */
    double load;           /* conductance of the line without nodes; 0: an amplifier holds it */
    bool on_data;          /* sync pulses come on the data wire: */
    double pulled_v;       /* volts(t) while it is pulled low */
    double recovery_ns;
    int64_t back_ns;       /* from its release until it is above the comparators' level */
    uint64_t seed;         /* of the noise */
};

struct skin;

struct skin *skin_create(const struct amplifier *amplifier);
void skin_free(struct skin *skin);

/* Returns the node's number, or −1 with the reason in `error`. */
int skin_add(struct skin *skin, const struct node_plan *plan, char *error, size_t error_size);
struct avr_node *skin_node(struct skin *skin, int node);

/* Announces an edge of the sync line. False if it precedes the last one or nodes have run past it. */
bool skin_sync(struct skin *skin, int64_t t_ns, bool level);

/* From a time on, not before the last edge, the data wire is stuck low. */
void skin_stick(struct skin *skin, int64_t t_ns);
/* Lowest voltage of the data wire while it was not pulled low: below 1.24 V comparators may see it. */
double skin_lowest(const struct skin *skin);

/* Runs all nodes to a time. */
void skin_run(struct skin *skin, int64_t t_ns);
/* Forgets edges before a time. */
void skin_forget(struct skin *skin, int64_t t_ns);

/* Voltage of the line at `size` instants from t_ns on, step_ns apart. */
void skin_volts(struct skin *skin, double t_ns, double step_ns, double *volts, size_t size);

#endif
