export function AbnormalView() { return null; }
