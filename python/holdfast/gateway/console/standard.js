// The areas and limits of the Modbus standard, and the types of values. The gateway fills them in.

/**
 * By the name of an area: its title, its read function, and the limits of one read and of one write.
 * By the name of a type: its width in registers, and its least and its greatest number.
 */
export const { AREAS, LAST_ADDRESS, MAX_WORD, TYPES } = $STANDARD;

/** Returns the area that a function code reads. */
export const areaOf = (code) => Object.values(AREAS).find((area) => area.code === code);
