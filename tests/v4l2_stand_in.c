/* A V4L2 camera without a camera: answers what a program asks of /dev/video90 and /dev/video91, when preloaded.

   cc -shared -fPIC -o stand_in.so v4l2_stand_in.c -ldl;  LD_PRELOAD=./stand_in.so V4L2_STAND_IN=FOLDER program

   It behaves as USB cameras do: formats with sizes of their own, a size that is not offered becomes another, a change of
   format makes the exposure automatic again, a time of exposure is not heeded while that is so, focus steps by five,
   pictures wait in four buffers, and what finds no buffer is lost. A picture is grey, of its number times 8 modulo 256.
   FOLDER/pulse is a FIFO: where it is, a byte in it exposes one picture. FOLDER/full: no bandwidth is left, streaming
   fails. FOLDER/picture.jpg is what MJPG sends. FOLDER/log has what was set. */

#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <linux/videodev2.h>
#include <poll.h>
#include <pthread.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/select.h>
#include <time.h>
#include <unistd.h>

#define DEVICES 2
#define FIRST 90
#define BUFFERS 8
#define MAX_BYTES (1280 * 800 * 2)

static const struct { __u32 format, width, height; } offered[] = {
    {V4L2_PIX_FMT_YUYV, 640, 480}, {V4L2_PIX_FMT_YUYV, 320, 240}, {V4L2_PIX_FMT_MJPEG, 640, 480},
    {V4L2_PIX_FMT_MJPEG, 1280, 800}, {V4L2_PIX_FMT_GREY, 640, 480}, {V4L2_PIX_FMT_GREY, 320, 240},
};
#define OFFERED (int)(sizeof offered / sizeof offered[0])

static struct device {
    int fd, mode, streaming, pulses, count, filled[BUFFERS], queued[BUFFERS], queue[BUFFERS], waiting;
    long number, of[BUFFERS];
    double next, fps, when[BUFFERS];
    unsigned char *memory[BUFFERS];
    int exposure_auto, exposure, gain, focus_auto, focus;
    size_t bytes[BUFFERS];
} devices[DEVICES];

static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;

static double now(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec + 1e-9 * t.tv_nsec;
}

static const char *in_folder(const char *name) {
    static __thread char path[500];
    snprintf(path, sizeof path, "%s/%s", getenv("V4L2_STAND_IN") ? getenv("V4L2_STAND_IN") : "/nowhere", name);
    return path;
}

static void note(const char *what, long value) {
    FILE *log = fopen(in_folder("log"), "a");
    if (log) fprintf(log, "%s %ld\n", what, value), fclose(log);
}

static struct device *by_fd(int fd) {
    for (int i = 0; i < DEVICES; i++)
        if (devices[i].fd == fd && fd > 0) return &devices[i];
    return NULL;
}

static void expose(struct device *d) { /* one picture, into the next buffer that waits; lost where there is none */
    d->number++;
    if (!d->waiting) return;
    int b = d->queue[0];
    memmove(d->queue, d->queue + 1, --d->waiting * sizeof(int));
    d->queued[b] = 0, d->filled[b] = 1, d->of[b] = d->number, d->when[b] = now();
    size_t pixels = (size_t)offered[d->mode].width * offered[d->mode].height;
    d->bytes[b] = pixels;
    if (offered[d->mode].format == V4L2_PIX_FMT_MJPEG) {
        FILE *file = fopen(in_folder("picture.jpg"), "rb");
        d->bytes[b] = file ? fread(d->memory[b], 1, MAX_BYTES, file) : 0;
        if (file) fclose(file);
    } else if (offered[d->mode].format == V4L2_PIX_FMT_GREY) {
        memset(d->memory[b], 8 * d->number % 256, pixels);
    } else {
        for (size_t i = 0; i < pixels; i++) d->memory[b][2 * i] = 8 * d->number % 256, d->memory[b][2 * i + 1] = 128;
        d->bytes[b] = 2 * pixels;
    }
}

static int ready(struct device *d) { /* the oldest picture that waits, -1 for none */
    char pulse[16];
    if (d->streaming && d->pulses > 0)
        for (ssize_t n = read(d->pulses, pulse, 1); n > 0; n = read(d->pulses, pulse, 1)) expose(d);
    while (d->streaming && d->pulses <= 0 && d->next <= now()) d->next += 1 / d->fps, expose(d);
    int oldest = -1;
    for (int b = 0; b < d->count; b++)
        if (d->filled[b] && (oldest < 0 || d->of[b] < d->of[oldest])) oldest = b;
    return oldest;
}

static int control(struct device *d, __u32 id, int set, int *value) {
    switch (id) {
    case V4L2_CID_EXPOSURE_AUTO:
        if (set) d->exposure_auto = *value, note("exposure_auto", *value);
        *value = d->exposure_auto; return 0;
    case V4L2_CID_EXPOSURE_ABSOLUTE:
        if (set && d->exposure_auto == V4L2_EXPOSURE_MANUAL) d->exposure = *value > 5000 ? 5000 : *value;
        if (set) note("exposure", *value);
        *value = d->exposure; return 0;
    case V4L2_CID_GAIN:
        if (set) d->gain = *value > 16 ? 16 : *value, note("gain", *value);
        *value = d->gain; return 0;
    case V4L2_CID_FOCUS_AUTO:
        if (set) d->focus_auto = *value, note("focus_auto", *value);
        *value = d->focus_auto; return 0;
    case V4L2_CID_FOCUS_ABSOLUTE:
        if (set && !d->focus_auto) d->focus = *value / 5 * 5;
        if (set) note("focus", *value);
        *value = d->focus; return 0;
    }
    errno = EINVAL;
    return -1;
}

static void fill_format(struct device *d, struct v4l2_format *f) {
    f->fmt.pix.width = offered[d->mode].width, f->fmt.pix.height = offered[d->mode].height;
    f->fmt.pix.pixelformat = offered[d->mode].format, f->fmt.pix.field = V4L2_FIELD_NONE;
    f->fmt.pix.bytesperline = f->fmt.pix.width * (f->fmt.pix.pixelformat == V4L2_PIX_FMT_YUYV ? 2 : 1);
    f->fmt.pix.sizeimage = MAX_BYTES;
}

static int set_format(struct device *d, struct v4l2_format *f) {
    int best = -1;
    for (int i = 0; i < OFFERED; i++)
        if (offered[i].format == f->fmt.pix.pixelformat &&
            (best < 0 || (offered[i].width == f->fmt.pix.width && offered[i].height == f->fmt.pix.height))) best = i;
    if (best < 0) best = d->mode;
    if (best != d->mode) d->exposure_auto = V4L2_EXPOSURE_APERTURE_PRIORITY; /* as many cameras do */
    d->mode = best;
    note("width", offered[best].width);
    fill_format(d, f);
    return 0;
}

static int answer(struct device *d, unsigned long request, void *data) {
    struct v4l2_buffer *b = data;
    struct v4l2_control *c = data;
    struct v4l2_streamparm *p = data;
    switch ((__u32)request) {
    case (__u32)VIDIOC_QUERYCAP: {
        struct v4l2_capability *cap = data;
        memset(cap, 0, sizeof *cap);
        strcpy((char *)cap->driver, "stand-in");
        cap->capabilities = cap->device_caps = V4L2_CAP_VIDEO_CAPTURE | V4L2_CAP_STREAMING;
        return 0;
    }
    case (__u32)VIDIOC_G_FMT: fill_format(d, data); return 0;
    case (__u32)VIDIOC_TRY_FMT: case (__u32)VIDIOC_S_FMT: return set_format(d, data);
    case (__u32)VIDIOC_ENUM_FRAMESIZES: {
        struct v4l2_frmsizeenum *size = data;
        for (int i = 0, k = 0; i < OFFERED; i++)
            if (offered[i].format == size->pixel_format && (__u32)k++ == size->index) {
                size->type = V4L2_FRMSIZE_TYPE_DISCRETE;
                size->discrete.width = offered[i].width, size->discrete.height = offered[i].height;
                return 0;
            }
        break;
    }
    case (__u32)VIDIOC_G_PARM: case (__u32)VIDIOC_S_PARM:
        if ((__u32)request == (__u32)VIDIOC_S_PARM && p->parm.capture.timeperframe.numerator)
            d->fps = (double)p->parm.capture.timeperframe.denominator / p->parm.capture.timeperframe.numerator;
        if (d->fps > 120) d->fps = 120;
        p->parm.capture.capability = V4L2_CAP_TIMEPERFRAME;
        p->parm.capture.timeperframe.numerator = 1000, p->parm.capture.timeperframe.denominator = 1000 * d->fps;
        return 0;
    case (__u32)VIDIOC_G_INPUT: *(int *)data = 0; return 0;
    case (__u32)VIDIOC_S_INPUT: return 0;
    case (__u32)VIDIOC_ENUMINPUT: if (((struct v4l2_input *)data)->index == 0) return 0; break;
    case (__u32)VIDIOC_QUERYCTRL: {
        struct v4l2_queryctrl *q = data;
        int value = 0;
        if (control(d, q->id, 0, &value)) return -1;
        q->type = V4L2_CTRL_TYPE_INTEGER, q->minimum = 0, q->maximum = 5000, q->step = 1, q->flags = 0;
        return 0;
    }
    case (__u32)VIDIOC_G_CTRL: return control(d, c->id, 0, &c->value);
    case (__u32)VIDIOC_S_CTRL: return control(d, c->id, 1, &c->value);
    case (__u32)VIDIOC_G_EXT_CTRLS: case (__u32)VIDIOC_S_EXT_CTRLS: {
        struct v4l2_ext_controls *all = data;
        for (__u32 i = 0; i < all->count; i++) {
            int value = all->controls[i].value;
            if (control(d, all->controls[i].id, (__u32)request == (__u32)VIDIOC_S_EXT_CTRLS, &value)) return -1;
            all->controls[i].value = value;
        }
        return 0;
    }
    case (__u32)VIDIOC_REQBUFS: {
        struct v4l2_requestbuffers *r = data;
        if (r->count > BUFFERS) r->count = BUFFERS;
        d->count = r->count, d->waiting = 0;
        memset(d->filled, 0, sizeof d->filled), memset(d->queued, 0, sizeof d->queued);
        return 0;
    }
    case (__u32)VIDIOC_QUERYBUF: b->length = MAX_BYTES, b->m.offset = b->index * MAX_BYTES; return 0;
    case (__u32)VIDIOC_QBUF:
        if (d->queued[b->index]) break;
        ready(d);
        d->filled[b->index] = 0, d->queued[b->index] = 1, d->queue[d->waiting++] = b->index;
        return 0;
    case (__u32)VIDIOC_DQBUF: {
        int oldest = ready(d);
        if (oldest < 0) { errno = EAGAIN; return -1; }
        d->filled[oldest] = 0;
        b->index = oldest, b->length = MAX_BYTES, b->bytesused = d->bytes[oldest], b->sequence = d->of[oldest];
        b->timestamp.tv_sec = d->when[oldest], b->timestamp.tv_usec = 1e6 * (d->when[oldest] - (long)d->when[oldest]);
        return 0;
    }
    case (__u32)VIDIOC_STREAMON:
        if (access(in_folder("full"), F_OK) == 0) { errno = ENOSPC; return -1; }
        if (d->pulses > 0) for (char rest[64]; read(d->pulses, rest, sizeof rest) > 0;) ; /* none was heard before */
        d->streaming = 1, d->next = now() + 1 / d->fps;
        return 0;
    case (__u32)VIDIOC_STREAMOFF:
        d->streaming = 0, d->waiting = 0;
        memset(d->filled, 0, sizeof d->filled), memset(d->queued, 0, sizeof d->queued);
        return 0;
    }
    errno = EINVAL;
    return -1;
}

static int open_device(const char *path) {
    int k;
    if (strncmp(path, "/dev/video", 10) || (k = atoi(path + 10) - FIRST) < 0 || k >= DEVICES) return -2;
    struct device *d = &devices[k];
    if (d->fps == 0) {
        d->fps = 30, d->exposure_auto = V4L2_EXPOSURE_APERTURE_PRIORITY, d->exposure = 157, d->focus_auto = 1;
        for (int b = 0; b < BUFFERS; b++) d->memory[b] = malloc(MAX_BYTES);
    }
    int (*real)(const char *, int, ...) = dlsym(RTLD_NEXT, "open");
    int fd = real("/dev/null", O_RDWR);
    if (d->fd <= 0) d->fd = fd, d->pulses = real(in_folder("pulse"), O_RDONLY | O_NONBLOCK);
    return fd;
}

int open(const char *path, int flags, ...) {
    va_list more;
    va_start(more, flags);
    int mode = va_arg(more, int), fd = open_device(path);
    va_end(more);
    int (*real)(const char *, int, ...) = dlsym(RTLD_NEXT, "open");
    return fd == -2 ? real(path, flags, mode) : fd;
}

int open64(const char *path, int flags, ...) {
    va_list more;
    va_start(more, flags);
    int mode = va_arg(more, int), fd = open_device(path);
    va_end(more);
    int (*real)(const char *, int, ...) = dlsym(RTLD_NEXT, "open64");
    return fd == -2 ? real(path, flags, mode) : fd;
}

int close(int fd) {
    struct device *d = by_fd(fd);
    int (*real)(int) = dlsym(RTLD_NEXT, "close");
    if (d) {
        if (d->pulses > 0) real(d->pulses);
        d->fd = d->pulses = d->streaming = 0;
    }
    return real(fd);
}

int ioctl(int fd, unsigned long request, ...) {
    va_list more;
    va_start(more, request);
    void *data = va_arg(more, void *);
    va_end(more);
    struct device *d = by_fd(fd);
    if (!d && ((request >> 8) & 0xFF) == 'V') d = &devices[0]; /* another handle of the device */
    if (!d) {
        int (*real)(int, unsigned long, ...) = dlsym(RTLD_NEXT, "ioctl");
        return real(fd, request, data);
    }
    pthread_mutex_lock(&lock);
    int result = answer(d, request, data);
    pthread_mutex_unlock(&lock);
    return result;
}

static void *map(int fd, off_t offset) {
    struct device *d = by_fd(fd);
    return d ? d->memory[offset / MAX_BYTES] : NULL;
}

void *mmap(void *at, size_t length, int protection, int flags, int fd, off_t offset) {
    void *memory = fd > 0 ? map(fd, offset) : NULL;
    void *(*real)(void *, size_t, int, int, int, off_t) = dlsym(RTLD_NEXT, "mmap");
    return memory ? memory : real(at, length, protection, flags, fd, offset);
}

void *mmap64(void *at, size_t length, int protection, int flags, int fd, off_t offset) {
    void *memory = fd > 0 ? map(fd, offset) : NULL;
    void *(*real)(void *, size_t, int, int, int, off_t) = dlsym(RTLD_NEXT, "mmap64");
    return memory ? memory : real(at, length, protection, flags, fd, offset);
}

int munmap(void *at, size_t length) {
    for (int i = 0; i < DEVICES; i++)
        for (int b = 0; b < BUFFERS; b++)
            if (at && devices[i].memory[b] == at) return 0;
    int (*real)(void *, size_t) = dlsym(RTLD_NEXT, "munmap");
    return real(at, length);
}

int select(int n, fd_set *in, fd_set *out, fd_set *odd, struct timeval *limit) {
    struct device *d = NULL;
    for (int i = 0; i < DEVICES && in; i++)
        if (devices[i].fd > 0 && devices[i].fd < n && FD_ISSET(devices[i].fd, in)) d = &devices[i];
    if (!d) {
        int (*real)(int, fd_set *, fd_set *, fd_set *, struct timeval *) = dlsym(RTLD_NEXT, "select");
        return real(n, in, out, odd, limit);
    }
    double end = now() + (limit ? limit->tv_sec + 1e-6 * limit->tv_usec : 1e9);
    for (;; usleep(2000)) {
        pthread_mutex_lock(&lock);
        int there = ready(d) >= 0;
        pthread_mutex_unlock(&lock);
        if (there) return 1;
        if (now() >= end) { FD_ZERO(in); return 0; }
    }
}
