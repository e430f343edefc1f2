# Rules of cmake --install for programs, protos, manual pages, completion, and the
# client library with a CMake package, for find_package(revisit) and
# revisit::client. Of the components client, server and dev,
# deploy/packages makes a package each.

include(CMakePackageConfigHelpers)
include(GNUInstallDirs)

install(TARGETS revisit COMPONENT client)
install(TARGETS revisitd COMPONENT server)
install(DIRECTORY ${PROJECT_SOURCE_DIR}/proto/revisit
        DESTINATION ${CMAKE_INSTALL_DATADIR}/revisit/proto COMPONENT dev
        FILES_MATCHING PATTERN "*.proto")
install(FILES ${PROJECT_SOURCE_DIR}/LICENSE
        DESTINATION ${CMAKE_INSTALL_DOCDIR} COMPONENT licence)

# The drive of `revisit demo`, which looks for it in share/ beside the directory of
# the program, whether that is built or installed.
set(drive ${PROJECT_SOURCE_DIR}/tests/data/boreas)
install(FILES ${drive}/boreas_glen_shields.csv ${drive}/NOTICE
        DESTINATION ${CMAKE_INSTALL_DATADIR}/revisit/demo COMPONENT client)
configure_file(${drive}/boreas_glen_shields.csv
               ${PROJECT_BINARY_DIR}/share/revisit/demo/boreas_glen_shields.csv
               COPYONLY)

# Manual pages and completion, which the programs write of themselves.
set(usage ${CMAKE_CURRENT_BINARY_DIR}/usage)
# CMake has an emulator run the programs of another machine where it sees that they are
# called; here one of its scripts calls it.
set(call_revisitd ${CMAKE_CROSSCOMPILING_EMULATOR} $<TARGET_FILE:revisitd>)
set(completion)
foreach(shell IN ITEMS bash zsh fish)
  list(APPEND completion COMMAND revisit completion ${shell}
       > ${usage}/revisit.${shell})
endforeach()
add_custom_command(
  OUTPUT ${usage}/revisit.bash ${usage}/revisit.zsh ${usage}/revisit.fish
         ${usage}/man/revisitd.1
  # Pages of commands that there are no longer.
  COMMAND ${CMAKE_COMMAND} -E rm -rf ${usage}/man
  COMMAND ${CMAKE_COMMAND} -E make_directory ${usage}/man
  COMMAND revisit man-pages ${usage}/man
  ${completion}
  COMMAND ${CMAKE_COMMAND} -D NAME=revisitd
          -D "ABOUT=keeps pose graphs and answers loop-closure candidates"
          -D "SYNOPSIS=[OPTIONS] [SUBCOMMAND]"
          -D "PROGRAM=${call_revisitd}"
          -D OUTPUT=${usage}/man/revisitd.1
          -P ${PROJECT_SOURCE_DIR}/server/settings/write_man_page.cmake
  DEPENDS revisit revisitd
          ${PROJECT_SOURCE_DIR}/server/settings/write_man_page.cmake
  VERBATIM)
add_custom_target(revisit_usage ALL DEPENDS ${usage}/revisit.bash)
install(DIRECTORY ${usage}/man/ DESTINATION ${CMAKE_INSTALL_MANDIR}/man1
        COMPONENT client PATTERN revisitd.1 EXCLUDE)
install(FILES ${usage}/man/revisitd.1 DESTINATION ${CMAKE_INSTALL_MANDIR}/man1
        COMPONENT server)
install(FILES ${usage}/revisit.bash RENAME revisit
        DESTINATION ${CMAKE_INSTALL_DATADIR}/bash-completion/completions
        COMPONENT client)
install(FILES ${usage}/revisit.zsh RENAME _revisit
        DESTINATION ${CMAKE_INSTALL_DATADIR}/zsh/site-functions
        COMPONENT client)
install(FILES ${usage}/revisit.fish
        DESTINATION ${CMAKE_INSTALL_DATADIR}/fish/vendor_completions.d
        COMPONENT client)

# The client library with the generated objects in it, since whoever links it has
# no other place to take them from.
add_library(revisit_client_package STATIC
  $<TARGET_OBJECTS:revisit_client> $<TARGET_OBJECTS:revisit_proto>
  $<TARGET_OBJECTS:revisit_proto_messages>)
set_target_properties(revisit_client_package PROPERTIES
  ARCHIVE_OUTPUT_DIRECTORY ${CMAKE_CURRENT_BINARY_DIR}/package
  EXPORT_NAME client
  LINKER_LANGUAGE CXX
  OUTPUT_NAME revisit_client)
target_compile_features(revisit_client_package INTERFACE cxx_std_17)
set(headers ${CMAKE_INSTALL_INCLUDEDIR}/revisit)
target_include_directories(revisit_client_package
  INTERFACE $<INSTALL_INTERFACE:${headers}>)
target_link_libraries(revisit_client_package
  INTERFACE protobuf::libprotobuf gRPC::grpc++ absl::cord absl::status
            absl::statusor absl::strings OpenSSL::Crypto OpenSSL::SSL
            Threads::Threads)
install(TARGETS revisit_client_package EXPORT revisit-targets COMPONENT dev)
install(FILES revisit/backoff.h revisit/candidate_watch.h revisit/channel.h
              revisit/client.h revisit/pose_stream.h revisit/status.h
        DESTINATION ${headers}/client/revisit COMPONENT dev)
install(DIRECTORY ${PROJECT_BINARY_DIR}/proto/generated/revisit
                  ${PROJECT_BINARY_DIR}/proto/generated/google
        DESTINATION ${headers} COMPONENT dev
        FILES_MATCHING PATTERN "*.pb.h")

set(package ${CMAKE_INSTALL_LIBDIR}/cmake/revisit)
install(EXPORT revisit-targets NAMESPACE revisit:: DESTINATION ${package}
        COMPONENT dev)
configure_package_config_file(
  revisit/revisit-config.cmake.in
  ${CMAKE_CURRENT_BINARY_DIR}/package/revisit-config.cmake
  INSTALL_DESTINATION ${package})
write_basic_package_version_file(
  ${CMAKE_CURRENT_BINARY_DIR}/package/revisit-config-version.cmake
  COMPATIBILITY SameMinorVersion)
install(FILES ${CMAKE_CURRENT_BINARY_DIR}/package/revisit-config.cmake
              ${CMAKE_CURRENT_BINARY_DIR}/package/revisit-config-version.cmake
        DESTINATION ${package} COMPONENT dev)
