# Run by CPack between installing the components and packing them: what Debian's
# policy asks of documents and programs, and where its zsh looks.

set(version ${CPACK_DEBIAN_PACKAGE_VERSION}-${CPACK_DEBIAN_PACKAGE_RELEASE})
# SOURCE_DATE_EPOCH counts.
string(TIMESTAMP date "%a, %d %b %Y %H:%M:%S +0000" UTC)

foreach(component IN LISTS CPACK_COMPONENTS_ALL)
  string(TOUPPER ${component} upper)
  set(name ${CPACK_DEBIAN_${upper}_PACKAGE_NAME})
  set(root ${CPACK_TEMPORARY_INSTALL_DIRECTORY}/${component})
  set(documents ${root}/usr/share/doc/${name})
  file(MAKE_DIRECTORY ${documents})
  file(COPY_FILE ${CPACK_REVISIT_SOURCE}/CHANGELOG.md ${documents}/changelog)
  file(WRITE ${documents}/changelog.Debian
"revisit (${version}) ${CPACK_REVISIT_DISTRIBUTION}; urgency=medium

  * Built from the sources of revisit ${CPACK_DEBIAN_PACKAGE_VERSION}; changelog.gz has what is new.

 -- ${CPACK_DEBIAN_PACKAGE_MAINTAINER}  ${date}
")
  file(COPY_FILE ${CPACK_REVISIT_SOURCE}/deploy/packages/copyright
       ${documents}/copyright)
  file(GLOB compressed ${documents}/changelog*
       ${root}/usr/share/man/man1/*.1)
  execute_process(COMMAND gzip -9nf ${compressed} COMMAND_ERROR_IS_FATAL ANY)
endforeach()

set(programs
    ${CPACK_TEMPORARY_INSTALL_DIRECTORY}/client/usr/bin/revisit
    ${CPACK_TEMPORARY_INSTALL_DIRECTORY}/server/usr/bin/revisitd)
execute_process(COMMAND ${CPACK_REVISIT_STRIP} --remove-section=.comment --remove-section=.note
                        ${programs} COMMAND_ERROR_IS_FATAL ANY)
file(GLOB_RECURSE libraries ${CPACK_TEMPORARY_INSTALL_DIRECTORY}/dev/*.a)
execute_process(COMMAND ${CPACK_REVISIT_STRIP} --strip-debug --remove-section=.comment
                        --remove-section=.note --enable-deterministic-archives
                        ${libraries} COMMAND_ERROR_IS_FATAL ANY)

set(zsh ${CPACK_TEMPORARY_INSTALL_DIRECTORY}/client/usr/share/zsh)
file(RENAME ${zsh}/site-functions ${zsh}/vendor-completions)
