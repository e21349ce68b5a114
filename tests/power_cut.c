// Keeps what a loss of power would leave of a process's files: of each file its bytes when it was last synced, under
// the name that its folder had for it when the file was synced first, or the folder since. Preloaded; needs two
// folders on one disk, POWER_CUT_FILES (what is watched) and POWER_CUT_DISK (what is left).
#define _GNU_SOURCE
#include <dirent.h>
#include <dlfcn.h>
#include <fcntl.h>
#include <limits.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

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

static void on_sync(int fd) {
  const char *files = getenv("POWER_CUT_FILES"), *disk = getenv("POWER_CUT_DISK");
  char own[64], path[PATH_MAX];
  struct stat status;
  snprintf(own, sizeof own, "/proc/self/fd/%d", fd);
  ssize_t length = readlink(own, path, sizeof path - 1);
  if (!files || !disk || length < 0 || fstat(fd, &status)) return;
  path[length] = 0;
  if (strncmp(path, files, strlen(files))) return;
  const char *name = path + strlen(files);
  if (S_ISREG(status.st_mode)) {
    keep_bytes(disk, path);
    keep_name(disk, path, name);
  } else if (S_ISDIR(status.st_mode)) {
    DIR *folder = opendir(path);
    for (struct dirent *entry; folder && (entry = readdir(folder));) {
      char child[2 * PATH_MAX];
      snprintf(child, sizeof child, "%s/%s", path, entry->d_name);
      if (entry->d_type == DT_REG) keep_name(disk, child, child + strlen(files));
    }
    if (folder) closedir(folder);
  }
}

#define WATCHED(function)                                         \
  int function(int fd) {                                          \
    int (*original)(int) = (int (*)(int))dlsym(RTLD_NEXT, #function); \
    int result = original(fd);                                    \
    if (result == 0) on_sync(fd);                                 \
    return result;                                                \
  }
WATCHED(fsync)
WATCHED(fdatasync)
