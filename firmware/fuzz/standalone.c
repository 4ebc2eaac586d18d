// SPDX-License-Identifier: Apache-2.0

/* Runs a harness without libFuzzer:
 *
 *     HARNESS [-runs=N] [-seed=N] [-max_total_time=S] [-timeout=S] FILE-OR-FOLDER …
 *
 * Runs the files, then N mutants of them, or as many as S seconds allow; ends with an error where one takes
 * longer than -timeout. It is not guided by coverage: it shows that past findings stay fixed, and little more.
 * Seconds are those of the processor, so that what it finds is the same on a busy machine. */
#include <dirent.h>
#include <signal.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

#define MOST 4096 /* bytes of an input */

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t size);

struct corpus {
    struct file {
        uint8_t bytes[MOST];
        size_t size;
    } *files;
    size_t size;
};

static uint64_t seed = 1;

/* SplitMix64 (Steele, Lea, Flood 2014) */
static uint64_t random_number(uint64_t below)
{
    uint64_t z = seed += 0x9E3779B97F4A7C15u;

    z = (z ^ z >> 30) * 0xBF58476D1CE4E5B9u;
    z = (z ^ z >> 27) * 0x94D049BB133111EBu;
    return (z ^ z >> 31) % below;
}

static void fail(const char *what, const char *path)
{
    fprintf(stderr, "fuzz: %s: %s\n", what, path);
    exit(2);
}

static void add_file(struct corpus *corpus, const char *path)
{
    FILE *file = fopen(path, "rb");

    if (!file)
        fail("cannot read the input", path);
    corpus->files = realloc(corpus->files, (corpus->size + 1) * sizeof *corpus->files);
    struct file *new = &corpus->files[corpus->size++];
    new->size = fread(new->bytes, 1, MOST, file);
    fclose(file);
}

static void add(struct corpus *corpus, const char *path)
{
    struct dirent **entries;
    char name[4096];
    struct stat about;

    if (stat(path, &about))
        fail("cannot find the input", path);
    if (!S_ISDIR(about.st_mode)) {
        add_file(corpus, path);
        return;
    }
    int count = scandir(path, &entries, NULL, alphasort);
    for (int i = 0; i < count; i++) {
        snprintf(name, sizeof name, "%s/%s", path, entries[i]->d_name);
        if (entries[i]->d_name[0] != '.')
            add_file(corpus, name);
        free(entries[i]);
    }
    free(entries);
}

/* The bytes from `from` on are moved to `to`, within the file. */
static void move(struct file *file, size_t from, size_t to)
{
    size_t size = file->size - from;

    if (to + size > MOST)
        size = MOST - to;
    memmove(file->bytes + to, file->bytes + from, size);
    file->size = to + size;
}

/* Makes one change: flips a bit, sets a byte, or removes, inserts or copies bytes from another file. */
static void mutate(struct file *file, const struct corpus *corpus)
{
    size_t place = random_number(file->size + 1), size = 1 + random_number(8);
    size_t left = file->size - place;
    const struct file *other = &corpus->files[random_number(corpus->size)];

    switch (random_number(5)) {
    case 0:
        if (left)
            file->bytes[place] ^= (uint8_t)(1u << random_number(8));
        break;
    case 1:
        if (left)
            file->bytes[place] = (uint8_t)random_number(256);
        break;
    case 2:
        move(file, place + (size < left ? size : left), place);
        break;
    case 3:
        if (place + size <= MOST) {
            move(file, place, place + size);
            for (size_t i = 0; i < size; i++)
                file->bytes[place + i] = (uint8_t)random_number(256);
        }
        break;
    case 4:
        size = other->size > place ? other->size - place : 0;
        memcpy(file->bytes + place, other->bytes + place, size);
        file->size = place + size;
        break;
    }
}

static void hangs(int signal)
{
    static const char said[] = "SUMMARY: timeout\n";

    (void)signal;
    (void)!write(STDERR_FILENO, said, sizeof said - 1);
    _exit(70);
}

static void run(const struct file *file, long timeout_s)
{
    const struct itimerval limit = {.it_value.tv_sec = timeout_s};
    uint8_t *bytes = malloc(file->size + !file->size); /* its ends are watched */

    memcpy(bytes, file->bytes, file->size);
    setitimer(ITIMER_PROF, &limit, NULL); /* 0: never */
    LLVMFuzzerTestOneInput(bytes, file->size);
    free(bytes);
}

int main(int argc, char **argv)
{
    struct corpus corpus = {0};
    static struct file mutant;
    unsigned long runs = 0, done = 0;
    clock_t most = 0;
    long timeout_s = 0;

    signal(SIGPROF, hangs);
    for (int i = 1; i < argc; i++) {
        if (!strncmp(argv[i], "-runs=", 6))
            runs = strtoul(argv[i] + 6, NULL, 10);
        else if (!strncmp(argv[i], "-seed=", 6))
            seed = strtoul(argv[i] + 6, NULL, 10);
        else if (!strncmp(argv[i], "-max_total_time=", 16))
            most = strtol(argv[i] + 16, NULL, 10) * CLOCKS_PER_SEC;
        else if (!strncmp(argv[i], "-timeout=", 9))
            timeout_s = strtol(argv[i] + 9, NULL, 10);
        else
            add(&corpus, argv[i]);
    }
    if (!corpus.size)
        fail("no input", argc > 1 ? argv[argc - 1] : "");
    for (size_t i = 0; i < corpus.size; i++)
        run(&corpus.files[i], timeout_s);
    for (; done < runs && (!most || clock() < most); done++) {
        mutant = corpus.files[random_number(corpus.size)];
        for (uint64_t changes = 1 + random_number(6); changes; changes--)
            mutate(&mutant, &corpus);
        run(&mutant, timeout_s);
    }
    printf("%lu inputs\n", (unsigned long)corpus.size + done);
    free(corpus.files);
    return 0;
}
