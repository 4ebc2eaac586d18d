# SPDX-License-Identifier: Apache-2.0

"""Claims that are false without a flag, on lines of an independent generator.

    make bench-doubt       QUICK=1: fewer frames; ONLY=hum: conditions with this in their name

Signals of `independent_line` pass through the driver's whole decoding chain, from the digitizer's
packets to what is published, and everything published is compared with what was true.

- `tally`: what is counted. A column is a field there.
- `words`, `lines`: every word of every frame, and the conditions of the line. A condition is a row
  of a table in `lines`.
- `mixtures`: skins and effects drawn at random, several at once, for the same counts.
- `touches`: claims of touch and of held values, where frames are lost.
- `zeros`: claims of zero, by skins that are tared under load, or torn.
- `bench`: runs all conditions (SOURCES) and reports; `kept`: what of that need not be run again.

A run that is interrupted goes on where it was, if no code has changed.

The sums that must be 0 are over all conditions; the shares of right words and of silences that are
flagged leave out the rough ones (`Condition.rough`), on which flags are due. Sound conditions run
twice, plain and with a scrambled skin, and both have shares of their own; `plain_few` is of the
plain ones in which three nodes or fewer speak, words and silences together.
"""
