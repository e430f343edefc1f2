# Compiles on x86-64 for arm64 with Debian's cross compiler, against the libraries of the
# Debian in REVISIT_ARM64_ROOT, which deploy/arm64/root makes.
set(CMAKE_SYSTEM_NAME Linux)
set(CMAKE_SYSTEM_PROCESSOR aarch64)
set(CMAKE_C_COMPILER aarch64-linux-gnu-gcc)
set(CMAKE_CXX_COMPILER aarch64-linux-gnu-g++)
set(CMAKE_LIBRARY_ARCHITECTURE aarch64-linux-gnu)

# CMake's trials of the compiler read this file too, in processes of their own.
list(APPEND CMAKE_TRY_COMPILE_PLATFORM_VARIABLES REVISIT_ARM64_ROOT)
set(CMAKE_SYSROOT ${REVISIT_ARM64_ROOT})
# Programs that the build runs are this machine's; all else is the other's.
set(CMAKE_FIND_ROOT_PATH ${REVISIT_ARM64_ROOT})
set(CMAKE_FIND_ROOT_PATH_MODE_PROGRAM NEVER)
set(CMAKE_FIND_ROOT_PATH_MODE_LIBRARY ONLY)
set(CMAKE_FIND_ROOT_PATH_MODE_INCLUDE ONLY)
set(CMAKE_FIND_ROOT_PATH_MODE_PACKAGE ONLY)
# What the build has made is run by qemu, as to let programs write their manual pages.
set(CMAKE_CROSSCOMPILING_EMULATOR qemu-aarch64-static -L ${REVISIT_ARM64_ROOT})

# GCC tells by notes, which no option asks for, that version 10 changed an ABI.
set(CMAKE_CXX_FLAGS_INIT -Wno-psabi)

set(ENV{PKG_CONFIG_SYSROOT_DIR} ${REVISIT_ARM64_ROOT})
# GCC tells by notes, which no option asks for, that version 10 changed an ABI.
set(CMAKE_CXX_FLAGS_INIT -Wno-psabi)

set(ENV{PKG_CONFIG_LIBDIR}
    ${REVISIT_ARM64_ROOT}/usr/lib/aarch64-linux-gnu/pkgconfig:${REVISIT_ARM64_ROOT}/usr/share/pkgconfig)
