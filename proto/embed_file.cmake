# usage: cmake -D FILE=... -D OUTPUT=... -D SYMBOL=... -P embed_file.cmake: a C++
# file in which SYMBOL holds the bytes of a file, and SYMBOLSize their number.
file(READ ${FILE} bytes HEX)
string(LENGTH "${bytes}" digits)
math(EXPR size "${digits} / 2")
string(REGEX REPLACE "(..)" "0x\\1," bytes "${bytes}")
string(REGEX REPLACE "(0x..,0x..,0x..,0x..,0x..,0x..,0x..,0x..,)" "\\1\n"
       bytes "${bytes}")
file(WRITE ${OUTPUT}
     "#include <cstddef>\nextern \"C\" {\n"
     "extern const std::size_t ${SYMBOL}Size;\n"
     "const std::size_t ${SYMBOL}Size = ${size};\n"
     "extern const unsigned char ${SYMBOL}[];\n"
     "const unsigned char ${SYMBOL}[] = {\n${bytes}\n};\n}\n")
