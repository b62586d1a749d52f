/* Preloaded into user-mode Linux, which otherwise starts no process on a processor with AMX.
 *
 * User-mode Linux 6.1 keeps 2,696 bytes of a process's extended registers: all that there were before AMX. It may read
 * fewer than there are, but Linux takes only all of them back (EFAULT). Here the rest is added as the process has it. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <elf.h>
#include <errno.h>
#include <stdarg.h>
#include <string.h>
#include <sys/ptrace.h>
#include <sys/types.h>
#include <sys/uio.h>

long ptrace(enum __ptrace_request request, ...)
{
    static long (*of_libc)(enum __ptrace_request, ...);
    if (!of_libc)
        of_libc = (long (*)(enum __ptrace_request, ...))dlsym(RTLD_NEXT, "ptrace");
    va_list more;
    va_start(more, request);
    pid_t process = va_arg(more, pid_t);
    void *address = va_arg(more, void *), *data = va_arg(more, void *);
    va_end(more);

    long result = of_libc(request, process, address, data);
    if (result != -1 || errno != EFAULT || request != PTRACE_SETREGSET || address != (void *)NT_X86_XSTATE)
        return result;
    static char registers[1 << 16];
    struct iovec *known = data, whole = {registers, sizeof registers};
    if (of_libc(PTRACE_GETREGSET, process, address, &whole) == -1 || whole.iov_len < known->iov_len) {
        errno = EFAULT;
        return -1;
    }
    memcpy(registers, known->iov_base, known->iov_len);
    return of_libc(PTRACE_SETREGSET, process, address, &whole);
}
