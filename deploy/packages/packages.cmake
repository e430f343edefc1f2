# Debian packages of an installation (client/install.cmake):
#   cpack --config build/release/CPackConfig.cmake
# makes revisit, revisit-server and librevisit-dev in build/release/packages, and
# with REVISIT_CONSOLE revisit-console.

include(GNUInstallDirs)

set(packages ${CMAKE_CURRENT_LIST_DIR})

# Files that only a package installs, to where the system looks for them.
install(FILES ${packages}/revisitd.conf DESTINATION /etc/revisit
        COMPONENT server EXCLUDE_FROM_ALL)
install(FILES ${packages}/revisitd.service DESTINATION /lib/systemd/system
        COMPONENT server EXCLUDE_FROM_ALL)

# The console's program and pages hold all that they need but Node.js.
option(REVISIT_CONSOLE
       "Package the console, which `deploy/console --build-only` has built" OFF)
if(REVISIT_CONSOLE)
  set(console ${PROJECT_SOURCE_DIR}/client/console/dist)
  if(NOT EXISTS ${console}/server/main.js)
    message(FATAL_ERROR "REVISIT_CONSOLE: first deploy/console --build-only")
  endif()
  install(DIRECTORY ${console}/ DESTINATION ${CMAKE_INSTALL_DATADIR}/revisit/console
          COMPONENT console EXCLUDE_FROM_ALL)
  install(PROGRAMS ${packages}/revisit-console DESTINATION ${CMAKE_INSTALL_BINDIR}
          COMPONENT console EXCLUDE_FROM_ALL)
  install(FILES ${packages}/console.conf DESTINATION /etc/revisit
          COMPONENT console EXCLUDE_FROM_ALL)
  install(FILES ${packages}/revisit-console.service DESTINATION /lib/systemd/system
          COMPONENT console EXCLUDE_FROM_ALL)
  find_program(REVISIT_NODE NAMES node nodejs REQUIRED)
  execute_process(
    COMMAND ${CMAKE_COMMAND} -D NAME=revisit-console
            -D "ABOUT=shows in a browser what a revisitd holds"
            -D "SYNOPSIS=[OPTIONS]"
            -D "PROGRAM=${REVISIT_NODE};${console}/server/main.js"
            -D OUTPUT=${PROJECT_BINARY_DIR}/packages/man/revisit-console.1
            -P ${PROJECT_SOURCE_DIR}/server/settings/write_man_page.cmake
    COMMAND_ERROR_IS_FATAL ANY)
  install(FILES ${PROJECT_BINARY_DIR}/packages/man/revisit-console.1
          DESTINATION ${CMAKE_INSTALL_MANDIR}/man1
          COMPONENT console EXCLUDE_FROM_ALL)
endif()

set(CPACK_GENERATOR DEB)
set(CPACK_VERBATIM_VARIABLES ON)
set(CPACK_PACKAGE_NAME revisit)
set(CPACK_PACKAGE_DIRECTORY ${PROJECT_BINARY_DIR}/packages)
set(CPACK_PACKAGING_INSTALL_PREFIX /usr)
set(CPACK_COMPONENTS_ALL client server dev)
if(REVISIT_CONSOLE)
  list(APPEND CPACK_COMPONENTS_ALL console)
endif()
set(CPACK_COMPONENTS_GROUPING ONE_PER_GROUP)
set(CPACK_DEB_COMPONENT_INSTALL ON)
# Directories are 0755 whatever umask built them.
set(CPACK_INSTALL_DEFAULT_DIRECTORY_PERMISSIONS
    OWNER_READ OWNER_WRITE OWNER_EXECUTE GROUP_READ GROUP_EXECUTE
    WORLD_READ WORLD_EXECUTE)
# Programs, pages and changelogs as Debian has them.
set(CPACK_PRE_BUILD_SCRIPTS ${packages}/finish.cmake)
set(CPACK_REVISIT_SOURCE ${PROJECT_SOURCE_DIR})
# The one for what the compiler makes.
set(CPACK_REVISIT_STRIP ${CMAKE_STRIP})

set(CPACK_DEBIAN_FILE_NAME DEB-DEFAULT)
# Packages are for the system whose libraries they were linked with, on which they
# depend: 12 and bookworm, say.
file(STRINGS ${CMAKE_SYSROOT}/etc/os-release system REGEX "^(ID|VERSION_ID|VERSION_CODENAME)=")
foreach(line IN LISTS system)
  string(REGEX MATCH "^([A-Z_]+)=\"?([^\"]*)" line "${line}")
  set(system_${CMAKE_MATCH_1} ${CMAKE_MATCH_2})
endforeach()
set(CPACK_REVISIT_DISTRIBUTION ${system_VERSION_CODENAME})
if(CMAKE_CROSSCOMPILING)
  # CPack asks dpkg for this machine's.
  set(CPACK_DEBIAN_PACKAGE_ARCHITECTURE arm64)
endif()
set(system_revision 1)
if(system_ID STREQUAL debian)
  set(system_revision 1~deb${system_VERSION_ID})
endif()
# Packages of a commit behind the release need a revision above it, such as
# 1~deb12+20261123, so that they count as newer.
set(REVISIT_PACKAGE_REVISION ${system_revision} CACHE STRING
    "Revision of the Debian packages, behind the version of revisit")
set(CPACK_DEBIAN_PACKAGE_VERSION ${PROJECT_VERSION})
set(CPACK_DEBIAN_PACKAGE_RELEASE ${REVISIT_PACKAGE_REVISION})
# Whoever publishes packages says who answers for them.
set(REVISIT_PACKAGE_MAINTAINER "revisit maintainers <maintainers@revisit.invalid>"
    CACHE STRING "Maintainer of the Debian packages")
set(CPACK_DEBIAN_PACKAGE_MAINTAINER ${REVISIT_PACKAGE_MAINTAINER})
set(CPACK_DEBIAN_PACKAGE_SHLIBDEPS ON)
set(CPACK_DEBIAN_PACKAGE_CONTROL_STRICT_PERMISSION ON)
set(CPACK_DEBIAN_COMPRESSION_TYPE xz)

set(about
"revisit keeps one pose graph per vehicle, takes streams of poses with
covariances, and answers with ranked loop-closure candidates: where a vehicle
has probably been before, by the shape of its trajectory.")

set(CPACK_DEBIAN_CLIENT_PACKAGE_NAME revisit)
set(CPACK_DEBIAN_CLIENT_PACKAGE_SECTION science)
set(CPACK_DEBIAN_CLIENT_PACKAGE_SUGGESTS revisit-server)
set(CPACK_DEBIAN_CLIENT_DESCRIPTION
"loop-closure candidates for vehicles - command line
${about}
.
This package has the command line: it streams recordings, asks for candidates,
draws maps, and evaluates drives whose truth is known. \"revisit demo\" and
\"revisit evaluate\" start a server of their own where revisit-server is
installed too.")

set(CPACK_DEBIAN_SERVER_PACKAGE_NAME revisit-server)
set(CPACK_DEBIAN_SERVER_PACKAGE_SECTION science)
# procps has the kill of the service's reload.
set(CPACK_DEBIAN_SERVER_PACKAGE_DEPENDS "adduser, procps")
set(CPACK_DEBIAN_SERVER_PACKAGE_RECOMMENDS revisit)
# Writes the scripts of a package with a service, and the list of its settings, of
# which there is one file. Its service runs as `user`; `at_purge` is a command.
function(revisit_service component unit user settings at_purge)
  set(REVISIT_UNIT ${unit})
  set(REVISIT_USER ${user})
  set(REVISIT_AT_PURGE ${at_purge})
  set(made ${PROJECT_BINARY_DIR}/packages/${component})
  foreach(script IN ITEMS postinst prerm postrm)
    configure_file(${packages}/service/${script}.in ${made}/${script} @ONLY
                   FILE_PERMISSIONS OWNER_READ OWNER_WRITE OWNER_EXECUTE
                   GROUP_READ GROUP_EXECUTE WORLD_READ WORLD_EXECUTE)
  endforeach()
  file(WRITE ${made}/conffiles "${settings}\n")
  string(TOUPPER ${component} upper)
  set(CPACK_DEBIAN_${upper}_PACKAGE_CONTROL_EXTRA
      ${made}/postinst ${made}/prerm ${made}/postrm ${made}/conffiles PARENT_SCOPE)
endfunction()

# The store goes, as the description says.
revisit_service(server revisitd revisit /etc/revisit/revisitd.conf
                "rm -rf /var/lib/revisit")
set(CPACK_DEBIAN_SERVER_DESCRIPTION
"loop-closure candidates for vehicles - server
${about}
.
This package has the server and its systemd service, which listens on the
loopback with a store in /var/lib/revisit until /etc/revisit/revisitd.conf says
otherwise. Removing the package keeps the store; purging it deletes the store.")

set(CPACK_DEBIAN_DEV_PACKAGE_NAME librevisit-dev)
set(CPACK_DEBIAN_DEV_PACKAGE_SECTION libdevel)
set(CPACK_DEBIAN_DEV_PACKAGE_DEPENDS
    "libabsl-dev, libgrpc++-dev, libprotobuf-dev, libssl-dev")
set(CPACK_DEBIAN_DEV_DESCRIPTION
"loop-closure candidates for vehicles - client library for C++
${about}
.
This package has the client library, whose streams resume where they were cut,
its headers, a CMake package, and the protos, from which gRPC generates clients
in other languages.")

set(CPACK_DEBIAN_CONSOLE_PACKAGE_NAME revisit-console)
set(CPACK_DEBIAN_CONSOLE_PACKAGE_SECTION science)
set(CPACK_DEBIAN_CONSOLE_PACKAGE_ARCHITECTURE all)
set(CPACK_DEBIAN_CONSOLE_PACKAGE_SHLIBDEPS OFF)
# As client/console/package.json has it.
set(CPACK_DEBIAN_CONSOLE_PACKAGE_DEPENDS "adduser, nodejs (>= 18.14.1)")
set(CPACK_DEBIAN_CONSOLE_PACKAGE_SUGGESTS revisit-server)
# It keeps nothing that could be deleted.
revisit_service(console revisit-console revisit-console /etc/revisit/console.conf
                ":")
set(CPACK_DEBIAN_CONSOLE_DESCRIPTION
"loop-closure candidates for vehicles - console
${about}
.
This package has the console: pages in the browser that show what a server
holds, and let people decide about candidates. Its systemd service listens on
the loopback, for a server there, until /etc/revisit/console.conf says
otherwise.")

include(CPack)
