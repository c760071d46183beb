/* Preloaded into a service and its workers: the n-th call on a file below IO_FAULT_ROOT that makes or writes one fails, or also one that
   reads or removes one. The file that IO_FAULT_PLAN names is shared memory with the test, which says when and how. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/types.h>
#include <sys/uio.h>
#include <unistd.h>

struct plan {
    _Atomic int calls;  /* counts down to the call that fails */
    _Atomic int error;  /* 0 while nothing is to fail */
    _Atomic int lasts;  /* whether all later calls fail too */
    _Atomic int reads;  /* whether reading and removing calls count */
    _Atomic int failed; /* calls that have failed */
};

static struct plan *plan;
static char root[4096];

__attribute__((constructor)) static void begin(void)
{
    const char *file = getenv("IO_FAULT_PLAN"), *below = getenv("IO_FAULT_ROOT");
    int opened = file && below ? open(file, O_RDWR | O_CLOEXEC) : -1;
    if (opened < 0)
        return;
    void *shared = mmap(NULL, sizeof *plan, PROT_READ | PROT_WRITE, MAP_SHARED, opened, 0);
    close(opened);
    if (shared == MAP_FAILED)
        abort();
    snprintf(root, sizeof root, "%s/", below);
    plan = shared;
}

enum kind { WRITES, READS };

static int fails(enum kind kind)
{
    if (kind == READS && !plan->reads)
        return 0;
    int left = atomic_fetch_sub(&plan->calls, 1);
    if (left > 1 || (left < 1 && !plan->lasts))
        return 0;
    atomic_fetch_add(&plan->failed, 1);
    errno = plan->error;
    return 1;
}

static int path_fails(const char *path, enum kind kind)
{
    return plan && plan->error && path && strncmp(path, root, strlen(root)) == 0 && fails(kind);
}

static int file_fails(int file, enum kind kind)
{
    if (!plan || !plan->error)
        return 0;
    char link[64], path[4096];
    snprintf(link, sizeof link, "/proc/self/fd/%d", file);
    ssize_t length = readlink(link, path, sizeof path - 1);
    if (length <= 0)
        return 0;
    path[length] = 0;
    return path_fails(path, kind);
}

#define REAL(result, name, ...) ((result (*)(__VA_ARGS__))dlsym(RTLD_NEXT, #name))

/* A full disk opens what is there, and a read-only one does not open it to be written. */
static enum kind opens_as(const char *path, int flags)
{
    if (plan && plan->error == EROFS)
        return (flags & O_ACCMODE) == O_RDONLY ? READS : WRITES;
    return flags & O_CREAT && access(path, F_OK) ? WRITES : READS;
}

#define OPENS(name)                                                            \
    int name(const char *path, int flags, ...)                                 \
    {                                                                          \
        va_list more;                                                          \
        va_start(more, flags);                                                 \
        mode_t mode = flags & O_CREAT ? va_arg(more, mode_t) : 0;              \
        va_end(more);                                                          \
        if (path_fails(path, opens_as(path, flags)))                           \
            return -1;                                                         \
        return REAL(int, name, const char *, int, ...)(path, flags, mode);     \
    }
OPENS(open)
OPENS(open64)

#define ON_FILE(result, name, kind, parameters, arguments, ...)                \
    result name parameters                                                     \
    {                                                                          \
        if (file_fails(file, kind))                                            \
            return -1;                                                         \
        return REAL(result, name, __VA_ARGS__) arguments;                      \
    }
ON_FILE(ssize_t, write, WRITES, (int file, const void *from, size_t count), (file, from, count), int, const void *, size_t)
ON_FILE(ssize_t, writev, WRITES, (int file, const struct iovec *from, int count), (file, from, count), int, const struct iovec *, int)
ON_FILE(ssize_t, pwrite, WRITES, (int file, const void *from, size_t count, off_t at), (file, from, count, at), int, const void *, size_t, off_t)
ON_FILE(ssize_t, pwrite64, WRITES, (int file, const void *from, size_t count, off64_t at), (file, from, count, at), int, const void *, size_t, off64_t)
ON_FILE(int, fsync, WRITES, (int file), (file), int)
ON_FILE(int, fdatasync, WRITES, (int file), (file), int)
ON_FILE(int, ftruncate, WRITES, (int file, off_t length), (file, length), int, off_t)
ON_FILE(int, ftruncate64, WRITES, (int file, off64_t length), (file, length), int, off64_t)
ON_FILE(ssize_t, read, READS, (int file, void *to, size_t count), (file, to, count), int, void *, size_t)
ON_FILE(ssize_t, pread, READS, (int file, void *to, size_t count, off_t at), (file, to, count, at), int, void *, size_t, off_t)
ON_FILE(ssize_t, pread64, READS, (int file, void *to, size_t count, off64_t at), (file, to, count, at), int, void *, size_t, off64_t)

#define ON_PATH(name, path, kind, parameters, arguments, ...)                  \
    int name parameters                                                        \
    {                                                                          \
        if (path_fails(path, kind))                                            \
            return -1;                                                         \
        return REAL(int, name, __VA_ARGS__) arguments;                         \
    }
ON_PATH(mkdir, path, WRITES, (const char *path, mode_t mode), (path, mode), const char *, mode_t)
ON_PATH(link, to, WRITES, (const char *from, const char *to), (from, to), const char *, const char *)
ON_PATH(linkat, to, WRITES, (int base, const char *from, int other, const char *to, int flags), (base, from, other, to, flags), int, const char *, int, const char *, int)
ON_PATH(rename, to, WRITES, (const char *from, const char *to), (from, to), const char *, const char *)
ON_PATH(unlink, path, READS, (const char *path), (path), const char *)
