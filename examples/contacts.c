/* Prints the contacts of all legs: the README's subscriber in C, for zenoh-pico 1.x.

     cc -std=c11 -O2 -DZENOH_LINUX contacts.c $(pkg-config --cflags --libs zenohpico) -o contacts
     ./contacts [tcp/127.0.0.1:7447 [KEY]]

   KEY is that of all legs' contacts where it is left out; -DZENOH_LINUX names the platform to
   zenoh-pico's headers.  No other library is needed: msgpack is read below, as far as a
   ContactEvent and a Heartbeat use it.  The last contact of each leg is asked for at the start and
   once a second, so that what a cut link has lost is known when it is back.

   No contact outlives its source: heartbeats say how old each leg's newest sample is.  A leg whose
   sample is older than 0.5 s, by them and the time since they came, is not known, whatever its last
   contact said (docs/messages.md, "When a leg is not known").  zenoh-pico calls back from a thread
   of its own, and main() watches the time: one lock is held by whoever prints. */

#define _POSIX_C_SOURCE 200809L

#include <ctype.h>
#include <inttypes.h>
#include <pthread.h>
#include <stdbool.h>
#include <stdio.h>
#include <string.h>
#include <time.h>
#include <zenoh-pico.h>

#define MOST_LEGS 64
#define MOST_NAME 32
#define MOST_BYTES 4096 /* of a heartbeat of 64 legs; an event of eight joints has some 250 */
#define MOST_DEPTH 8
#define KNOWN_S 0.5 /* a leg's newest sample is not older */
#define LOOK_S 0.1  /* from one look at the time to the next */
#define ASK_LOOKS 10

typedef struct {
    const uint8_t *at, *end;
    bool good;
} reader_t;

typedef struct {
    char leg[MOST_NAME + 1];
    int64_t t_ns;
    double score;
    bool contact, withheld;
} event_t;

typedef enum { NIL, BOOLEAN, INTEGER, REAL, TEXT, ARRAY, MAP } kind_t;

/* A msgpack value; of an array or a map only the number of its members, which follow. */
typedef struct {
    kind_t kind;
    int64_t integer; /* also of a boolean, and how many members or bytes there are */
    double real;
    const uint8_t *text;
} value_t;

static uint64_t take(reader_t *reader, size_t bytes) {
    uint64_t value = 0;
    if ((size_t)(reader->end - reader->at) < bytes) {
        reader->good = false;
        return 0;
    }
    for (size_t i = 0; i < bytes; i++) value = value << 8 | *reader->at++;
    return value;
}

static value_t text_of(reader_t *reader, size_t bytes) {
    value_t value = {.kind = TEXT, .integer = (int64_t)bytes, .text = reader->at};
    if ((size_t)(reader->end - reader->at) < bytes) {
        reader->good = false;
        value.integer = 0;
    } else {
        reader->at += bytes;
    }
    return value;
}

static double real_of(uint64_t bits, size_t bytes) {
    if (bytes == 4) {
        uint32_t half = (uint32_t)bits;
        float value;
        memcpy(&value, &half, sizeof value);
        return value;
    }
    double value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

static value_t next(reader_t *reader) {
    uint8_t code = (uint8_t)take(reader, 1);
    if (code < 0x80) return (value_t){.kind = INTEGER, .integer = code};
    if (code < 0x90) return (value_t){.kind = MAP, .integer = code & 0x0f};
    if (code < 0xa0) return (value_t){.kind = ARRAY, .integer = code & 0x0f};
    if (code < 0xc0) return text_of(reader, code & 0x1f);
    if (code >= 0xe0) return (value_t){.kind = INTEGER, .integer = (int8_t)code};
    switch (code) {
        case 0xc0: return (value_t){.kind = NIL};
        case 0xc2: case 0xc3: return (value_t){.kind = BOOLEAN, .integer = code & 1};
        case 0xca: return (value_t){.kind = REAL, .real = real_of(take(reader, 4), 4)};
        case 0xcb: return (value_t){.kind = REAL, .real = real_of(take(reader, 8), 8)};
        case 0xcc: case 0xcd: case 0xce: case 0xcf:
            return (value_t){.kind = INTEGER,
                             .integer = (int64_t)take(reader, (size_t)1 << (code - 0xcc))};
        case 0xd0: return (value_t){.kind = INTEGER, .integer = (int8_t)take(reader, 1)};
        case 0xd1: return (value_t){.kind = INTEGER, .integer = (int16_t)take(reader, 2)};
        case 0xd2: return (value_t){.kind = INTEGER, .integer = (int32_t)take(reader, 4)};
        case 0xd3: return (value_t){.kind = INTEGER, .integer = (int64_t)take(reader, 8)};
        case 0xd9: return text_of(reader, (size_t)take(reader, 1));
        case 0xda: return text_of(reader, (size_t)take(reader, 2));
        case 0xdc: return (value_t){.kind = ARRAY, .integer = (int64_t)take(reader, 2)};
        case 0xde: return (value_t){.kind = MAP, .integer = (int64_t)take(reader, 2)};
        default: reader->good = false; return (value_t){.kind = NIL};
    }
}

/* Go on behind a value's members, if it has any. */
static void skip(reader_t *reader, value_t value, int depth) {
    int64_t members = value.kind == MAP || value.kind == ARRAY ? value.integer : 0;
    if (value.kind == MAP) members *= 2;
    if (depth > MOST_DEPTH) reader->good = false;
    for (int64_t i = 0; i < members && reader->good; i++) skip(reader, next(reader), depth + 1);
}

static bool is(value_t key, const char *name) {
    return key.kind == TEXT && (size_t)key.integer == strlen(name) &&
           memcmp(key.text, name, strlen(name)) == 0;
}

/* What a leg is called: nothing that a terminal could obey. */
static bool is_name(value_t text) {
    for (int64_t i = 0; i < text.integer; i++) {
        if (!isalnum(text.text[i]) && !strchr("_.-", text.text[i])) return false;
    }
    return text.integer > 0 && text.integer <= MOST_NAME && text.text[0] != 0;
}

/* Fields that are unknown are left out, as docs/messages.md wants it. */
static bool read_event(const uint8_t *data, size_t size, event_t *event) {
    reader_t reader = {data, data + size, true};
    value_t map = next(&reader);
    int found = 0;
    *event = (event_t){0};
    if (map.kind != MAP) return false;
    for (int64_t i = 0; i < map.integer && reader.good; i++) {
        value_t key = next(&reader), value = next(&reader);
        if (is(key, "leg") && value.kind == TEXT && is_name(value)) {
            memcpy(event->leg, value.text, (size_t)value.integer);
            found |= 1;
        } else if (is(key, "t_ns") && value.kind == INTEGER) {
            event->t_ns = value.integer;
            found |= 2;
        } else if (is(key, "contact") && value.kind == BOOLEAN) {
            event->contact = value.integer != 0;
            found |= 4;
        } else if (is(key, "score") && (value.kind == REAL || value.kind == INTEGER)) {
            event->score = value.kind == REAL ? value.real : (double)value.integer;
        } else if (is(key, "withheld") && value.kind == BOOLEAN) {
            event->withheld = value.integer != 0;
        }
        skip(&reader, value, 0);
    }
    return reader.good && found == 7;
}

/* What is known of each leg.  An event that is asked for again is no news. */
typedef struct {
    event_t event;
    double sampled_s; /* when its newest sample came to the service, by this clock, or before */
    bool known;
} leg_t;

static leg_t legs[MOST_LEGS];
static size_t count;
static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;

static double now_s(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

/* The leg of that name, made if need be; NULL where there is no room for another. */
static leg_t *leg_of(const char *name) {
    size_t i = 0;
    while (i < count && strcmp(legs[i].event.leg, name) != 0) i++;
    if (i == MOST_LEGS) return NULL;
    if (i == count) {
        legs[count++] = (leg_t){.sampled_s = now_s(), .known = true}; /* until heartbeats say more */
        strcpy(legs[i].event.leg, name);
    }
    return &legs[i];
}

static bool is_news(const event_t *event) {
    leg_t *leg = leg_of(event->leg);
    if (leg == NULL) return true;
    bool known = leg->event.t_ns == event->t_ns && leg->event.contact == event->contact;
    leg->event = *event;
    return !known;
}

/* A payload of at most MOST_BYTES; its size, 0 for a larger one. */
static size_t payload_of(const z_loaned_sample_t *sample, uint8_t *data) {
    z_bytes_reader_t reader = z_bytes_get_reader(z_sample_payload(sample));
    size_t size = z_bytes_reader_read(&reader, data, MOST_BYTES);
    return z_bytes_reader_remaining(&reader) > 0 ? 0 : size;
}

static void print_contact(const z_loaned_sample_t *sample) {
    uint8_t data[MOST_BYTES];
    size_t size = payload_of(sample, data);
    event_t event;
    pthread_mutex_lock(&lock);
    if (size > 0 && data[0] == '{') {
        fprintf(stderr, "contacts: an event is JSON; run serve without --json\n");
    } else if (!read_event(data, size, &event)) {
        fprintf(stderr, "contacts: a payload of %zu bytes is no contact event\n",
                z_bytes_len(z_sample_payload(sample)));
    } else if (is_news(&event)) {
        const char *what = event.contact ? "touches" : event.withheld ? "is withheld" : "lets go";
        printf("%s %s at %" PRId64 ".%03" PRId64 " s, score %.1f\n", event.leg, what,
               event.t_ns / 1000000000, event.t_ns / 1000000 % 1000, event.score);
        fflush(stdout);
    }
    pthread_mutex_unlock(&lock);
}

/* Take the ages of a heartbeat in; a leg that it lacks is not known, nor is any of one that is
   broken. */
static void take_heartbeat(const uint8_t *data, size_t size) {
    reader_t reader = {data, data + size, true};
    value_t map = next(&reader);
    double arrived_s = now_s();
    for (size_t i = 0; i < count; i++) legs[i].sampled_s = arrived_s - 2 * KNOWN_S;
    if (map.kind != MAP) return;
    for (int64_t i = 0; i < map.integer && reader.good; i++) {
        value_t key = next(&reader), value = next(&reader);
        if (!is(key, "legs") || value.kind != MAP) {
            skip(&reader, value, 0);
            continue;
        }
        for (int64_t j = 0; j < value.integer && reader.good; j++) {
            value_t name = next(&reader), beat = next(&reader);
            char id[MOST_NAME + 1] = {0};
            double age_s = 2 * KNOWN_S;
            bool named = name.kind == TEXT && is_name(name);
            if (named) memcpy(id, name.text, (size_t)name.integer);
            for (int64_t k = 0; beat.kind == MAP && k < beat.integer && reader.good; k++) {
                value_t field = next(&reader), of = next(&reader);
                if (is(field, "age_s") && of.kind == REAL) age_s = of.real;
                if (is(field, "age_s") && of.kind == INTEGER) age_s = (double)of.integer;
                skip(&reader, of, 0);
            }
            if (beat.kind != MAP) skip(&reader, beat, 0);
            leg_t *leg = named && reader.good ? leg_of(id) : NULL;
            if (leg != NULL && age_s >= 0.0) leg->sampled_s = arrived_s - age_s;
        }
    }
}

/* Print which legs are not known any more, and which are again. */
static void look(void) {
    pthread_mutex_lock(&lock);
    double at_s = now_s();
    for (size_t i = 0; i < count; i++) {
        bool known = at_s - legs[i].sampled_s <= KNOWN_S;
        if (known != legs[i].known) {
            printf("%s is %s\n", legs[i].event.leg, known ? "known again" : "not known");
            fflush(stdout);
        }
        legs[i].known = known;
    }
    pthread_mutex_unlock(&lock);
}

static void on_sample(z_loaned_sample_t *sample, void *context) {
    (void)context;
    print_contact(sample);
}

static void on_heartbeat(z_loaned_sample_t *sample, void *context) {
    uint8_t data[MOST_BYTES];
    size_t size = payload_of(sample, data);
    (void)context;
    pthread_mutex_lock(&lock);
    take_heartbeat(data, size);
    pthread_mutex_unlock(&lock);
}

static void on_reply(z_loaned_reply_t *reply, void *context) {
    (void)context;
    if (z_reply_is_ok(reply)) print_contact(z_reply_ok(reply));
}

/* The key of the heartbeats beside contacts: robot/service, with the namespace of theirs. */
static bool heartbeat_key(const char *key, char *made, size_t size) {
    const char *at = strstr(key, "robot/leg/");
    int prefix = at == NULL ? 0 : (int)(at - key);
    int length = snprintf(made, size, "%.*srobot/service", prefix, key);
    return length > 0 && (size_t)length < size;
}

int main(int argc, char **argv) {
    const char *endpoint = argc > 1 ? argv[1] : "tcp/127.0.0.1:7447";
    const char *key = argc > 2 ? argv[2] : "robot/leg/*/contact";
    char service[256];
    z_view_keyexpr_t contacts, heartbeats;
    if (!heartbeat_key(key, service, sizeof service) ||
        z_view_keyexpr_from_str(&heartbeats, service) < 0 ||
        z_view_keyexpr_from_str(&contacts, key) < 0) {
        fprintf(stderr, "contacts: '%s' is no key; give one such as robot/leg/*/contact\n", key);
        return 2;
    }
    z_owned_config_t config;
    z_config_default(&config);
    zp_config_insert(z_loan_mut(config), Z_CONFIG_MODE_KEY, "client");
    zp_config_insert(z_loan_mut(config), Z_CONFIG_CONNECT_KEY, endpoint);
    z_owned_session_t session;
    if (z_open(&session, z_move(config), NULL) < 0) {
        fprintf(stderr, "contacts: no router at %s; start `adaptive-contact serve`\n", endpoint);
        return 2;
    }
    z_owned_closure_sample_t callback;
    z_closure(&callback, on_sample, NULL, NULL);
    z_owned_subscriber_t subscriber;
    if (z_declare_subscriber(z_loan(session), &subscriber, z_loan(contacts), z_move(callback), NULL)) {
        fprintf(stderr, "contacts: the router refuses a subscriber to %s\n", key);
        return 2;
    }
    z_owned_closure_sample_t beat;
    z_closure(&beat, on_heartbeat, NULL, NULL);
    z_owned_subscriber_t beats;
    if (z_declare_subscriber(z_loan(session), &beats, z_loan(heartbeats), z_move(beat), NULL)) {
        fprintf(stderr, "contacts: the router refuses a subscriber to %s\n", service);
        return 2;
    }
    printf("contacts: listening to %s at %s\n", key, endpoint);
    fflush(stdout);
    const struct timespec pause = {.tv_nsec = (long)(LOOK_S * 1e9)};
    for (int looks = 0;; looks++) {
        if (looks % ASK_LOOKS == 0) {
            z_owned_closure_reply_t asked;
            z_closure(&asked, on_reply, NULL, NULL);
            z_get(z_loan(session), z_loan(contacts), "", z_move(asked), NULL);
        }
        nanosleep(&pause, NULL);
        look();
    }
}
