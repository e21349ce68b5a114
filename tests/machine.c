// A machine of its own for the processes that this is preloaded into, whose disk and clock can fail. The folder
// MACHINE_FILES lies on its disk.
//
// Power: the folder MACHINE_DISK has what a loss of power would leave of the files: of each its bytes when it was last
// synced, under the name that its folder had for it when the file was synced first, or the folder since. A name that was
// removed is gone with the next sync in its folder: file systems keep the order of such changes. Both folders must be on
// one disk of the real machine.
//
// MACHINE_STATE is a file of two 64-bit numbers, which may change at any time: the error of everything that writes to
// the disk, 0 for none (ENOSPC: it is full; EROFS: it can only be read), and by how many seconds the clock is wrong.
#define _GNU_SOURCE
#include <dirent.h>
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/file.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

#define ORIGINAL(function) ((__typeof__(&function))dlsym(RTLD_NEXT, #function))

static const volatile struct { int64_t error, seconds; } healthy, *state = (const void *)&healthy;

__attribute__((constructor)) static void watch_state(void) {
  int fd = open(getenv("MACHINE_STATE"), O_RDONLY);
  void *mapped = mmap(NULL, sizeof healthy, PROT_READ, MAP_SHARED, fd, 0);
  if (mapped == MAP_FAILED) abort();
  state = mapped;
  close(fd);
}

static void make_folders(char *path) {
  for (char *end = strchr(path + 1, '/'); end; end = strchr(end + 1, '/')) {
    *end = 0;
    mkdir(path, 0777);
    *end = '/';
  }
}

static void unique(char *path, const char *disk) {
  static __thread long number;
  snprintf(path, PATH_MAX, "%s/.new-%d-%p-%ld", disk, getpid(), (void *)&number, number++);
}

// An inode's number is given to another file soon after a file was deleted: its time of birth tells them apart.
static int name_of_inode(char *path, const char *disk, const char *file) {
  struct statx status;
  if (statx(AT_FDCWD, file, 0, STATX_INO | STATX_BTIME | STATX_TYPE, &status) || !S_ISREG(status.stx_mode)) return -1;
  snprintf(path, PATH_MAX, "%s/.inodes/%llu-%lld.%u", disk, (unsigned long long)status.stx_ino,
           (long long)status.stx_btime.tv_sec, status.stx_btime.tv_nsec);
  make_folders(path);
  return 0;
}

// The folder's name for a file is on the disk, too.
static void keep_name(const char *disk, const char *file, const char *name) {
  char kept[PATH_MAX], target[PATH_MAX], link_name[PATH_MAX];
  if (name_of_inode(kept, disk, file)) return;
  snprintf(target, sizeof target, "%s%s", disk, name);
  make_folders(target);
  unique(link_name, disk);
  if (link(kept, link_name) == 0 && rename(link_name, target) == 0) unlink(link_name);
}

static void keep_bytes(const char *disk, const char *file) {
  char kept[PATH_MAX], made[PATH_MAX], buffer[65536];
  if (name_of_inode(kept, disk, file)) return;
  unique(made, disk);
  int in = open(file, O_RDONLY), out = open(made, O_WRONLY | O_CREAT | O_TRUNC, 0666);
  for (ssize_t got; (got = read(in, buffer, sizeof buffer)) > 0;)
    if (write(out, buffer, got) != got) abort();
  close(in);
  close(out);
  rename(made, kept);
}

static void forget_removed(const char *disk, const char *folder, const char *name) {
  char kept[PATH_MAX], path[PATH_MAX];
  struct stat status;
  snprintf(kept, sizeof kept, "%s%s", disk, name);
  DIR *names = opendir(kept);
  for (struct dirent *entry; names && (entry = readdir(names));) {
    if (entry->d_type != DT_REG || entry->d_name[0] == '.') continue;  // our own, and temporary files
    snprintf(path, sizeof path, "%s/%s", folder, entry->d_name);
    if (stat(path, &status) == 0 || errno != ENOENT) continue;
    snprintf(path, sizeof path, "%s/%s", kept, entry->d_name);
    ORIGINAL(unlink)(path);
  }
  if (names) closedir(names);
}

static void on_sync(int fd) {
  const char *files = getenv("MACHINE_FILES"), *disk = getenv("MACHINE_DISK");
  char own[PATH_MAX], path[PATH_MAX];
  struct stat status;
  snprintf(own, sizeof own, "/proc/self/fd/%d", fd);
  ssize_t length = readlink(own, path, sizeof path - 1);
  if (!files || !disk || length < 0 || fstat(fd, &status)) return;
  path[length] = 0;
  if (strncmp(path, files, strlen(files))) return;
  char *name = path + strlen(files);
  snprintf(own, sizeof own, "%s/.lock", disk);
  int lock = open(own, O_RDWR | O_CREAT | O_CLOEXEC, 0666);  // the later one of two syncs has the later bytes
  flock(lock, LOCK_EX);
  if (S_ISREG(status.st_mode)) {
    keep_bytes(disk, path);
    keep_name(disk, path, name);
    *strrchr(name, '/') = 0;
  } else if (S_ISDIR(status.st_mode)) {
    DIR *folder = opendir(path);
    for (struct dirent *entry; folder && (entry = readdir(folder));) {
      char child[2 * PATH_MAX];
      snprintf(child, sizeof child, "%s/%s", path, entry->d_name);
      if (entry->d_type == DT_REG) keep_name(disk, child, child + strlen(files));
    }
    if (folder) closedir(folder);
  }
  forget_removed(disk, path, name);
  close(lock);
}

static int is_of_disk(const char *path) { return !strncmp(path, getenv("MACHINE_FILES"), strlen(getenv("MACHINE_FILES"))); }

// Whether something that writes to this path, or where it is null to this open file, fails now.
static int fails(const char *path, int fd) {
  char own[64], target[PATH_MAX];
  if (!state->error) return 0;
  if (!path) {
    snprintf(own, sizeof own, "/proc/self/fd/%d", fd);
    ssize_t length = readlink(own, target, sizeof target - 1);
    if (length < 0) return 0;
    target[length] = 0;
    path = target;
  }
  if (!is_of_disk(path)) return 0;
  errno = state->error;
  return 1;
}

#define SYNCING(function)                  \
  int function(int fd) {                   \
    int result = ORIGINAL(function)(fd);   \
    if (result == 0) on_sync(fd);          \
    return result;                         \
  }
#define WRITING(type, function, path, fd, arguments, ...) \
  type function arguments { return fails(path, fd) ? -1 : ORIGINAL(function)(__VA_ARGS__); }
// Files that are opened only to be read can be opened; on a full disk also those that are there already.
#define OPENING(function)                                                                       \
  int function(const char *path, int flags, ...) {                                              \
    va_list rest;                                                                               \
    va_start(rest, flags);                                                                      \
    mode_t mode = va_arg(rest, mode_t);                                                         \
    va_end(rest);                                                                               \
    int writes = state->error == EROFS ? flags & (O_WRONLY | O_RDWR | O_CREAT) : flags & O_CREAT; \
    return writes && fails(path, -1) ? -1 : ORIGINAL(function)(path, flags, mode);              \
  }

SYNCING(fsync)
SYNCING(fdatasync)
OPENING(open)
OPENING(open64)
WRITING(ssize_t, write, NULL, fd, (int fd, const void *bytes, size_t size), fd, bytes, size)
WRITING(ssize_t, pwrite, NULL, fd, (int fd, const void *bytes, size_t size, off_t at), fd, bytes, size, at)
WRITING(ssize_t, pwrite64, NULL, fd, (int fd, const void *bytes, size_t size, off64_t at), fd, bytes, size, at)
WRITING(int, ftruncate, NULL, fd, (int fd, off_t size), fd, size)
WRITING(int, ftruncate64, NULL, fd, (int fd, off64_t size), fd, size)
WRITING(int, mkdir, path, -1, (const char *path, mode_t mode), path, mode)
WRITING(int, rename, to, -1, (const char *from, const char *to), from, to)

int unlink(const char *path) {  // a full disk is made less full
  return state->error == EROFS && fails(path, -1) ? -1 : ORIGINAL(unlink)(path);
}

int clock_gettime(clockid_t clock, struct timespec *now) {
  int result = ORIGINAL(clock_gettime)(clock, now);
  if (clock == CLOCK_REALTIME) now->tv_sec += state->seconds;
  return result;
}

int gettimeofday(struct timeval *now, void *zone) {
  int result = ORIGINAL(gettimeofday)(now, zone);
  now->tv_sec += state->seconds;
  return result;
}

time_t time(time_t *result) {
  struct timespec now;
  clock_gettime(CLOCK_REALTIME, &now);
  if (result) *result = now.tv_sec;
  return now.tv_sec;
}
