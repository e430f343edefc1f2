# Makes the programs need no library but those of the C library: every library that was
# found as a shared one is linked from its static archive. deploy/portable/build has CMake
# read this at project() (CMAKE_PROJECT_INCLUDE). What is compiled stays as it is, so
# compilations of a build with shared libraries are found in ccache.
#
#   REVISIT_ARCHIVES   directory of the archives that Debian has none of

set(CMAKE_FIND_LIBRARY_SUFFIXES .a .so)
set(CMAKE_SKIP_RPATH ON)

# The archive in place of a library: the one in REVISIT_ARCHIVES, else the one beside it.
# A library without one stays: it may be one that the programs do not need, and
# deploy/portable/build judges what they need in the end.
function(revisit_archive_of LIBRARY ARCHIVE)
  set(${ARCHIVE} ${LIBRARY} PARENT_SCOPE)
  cmake_path(GET LIBRARY PARENT_PATH directory)
  cmake_path(GET LIBRARY FILENAME name)
  string(REGEX REPLACE "\\.(so|a)[.0-9]*$" ".a" name "${name}")
  foreach(place IN ITEMS ${REVISIT_ARCHIVES} ${directory})
    if(EXISTS ${place}/${name})
      set(${ARCHIVE} ${place}/${name} PARENT_SCOPE)
      return()
    endif()
  endforeach()
endfunction()

function(revisit_link_archives)
  get_property(targets DIRECTORY ${CMAKE_SOURCE_DIR} PROPERTY IMPORTED_TARGETS)
  foreach(target IN LISTS targets)
    get_target_property(type ${target} TYPE)
    if(type MATCHES "^(SHARED|STATIC|UNKNOWN)_LIBRARY$")
      get_target_property(configurations ${target} IMPORTED_CONFIGURATIONS)
      set(properties IMPORTED_LOCATION)
      foreach(configuration IN LISTS configurations)
        list(APPEND properties IMPORTED_LOCATION_${configuration})
      endforeach()
      foreach(property IN LISTS properties)
        get_target_property(library ${target} ${property})
        if(library)
          revisit_archive_of(${library} archive)
          set_target_properties(${target} PROPERTIES ${property} ${archive})
        endif()
      endforeach()
    endif()
    # The targets of pkg-config name their libraries only here.
    get_target_property(linked ${target} INTERFACE_LINK_LIBRARIES)
    if(linked)
      set(replaced)
      foreach(library IN LISTS linked)
        if(library MATCHES "^/.*/lib[^/]*\\.(so|a)[.0-9]*$")
          revisit_archive_of(${library} library)
        endif()
        list(APPEND replaced "${library}")
      endforeach()
      set_target_properties(${target} PROPERTIES
                            INTERFACE_LINK_LIBRARIES "${replaced}")
    endif()
  endforeach()
endfunction()

# Has the server's functions stand before those of an OpenSSL within the program.
function(revisit_wrap_openssl)
  target_compile_definitions(revisit_listener PRIVATE REVISIT_OPENSSL_ARCHIVE)
  target_link_options(revisitd PRIVATE -Wl,--wrap=SSL_new,--wrap=SSL_read)
endfunction()

# At the end of CMakeLists.txt, when all libraries have been found.
cmake_language(DEFER DIRECTORY ${CMAKE_SOURCE_DIR} CALL revisit_link_archives)
cmake_language(DEFER DIRECTORY ${CMAKE_SOURCE_DIR} CALL revisit_wrap_openssl)
